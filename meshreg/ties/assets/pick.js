// The page of `meshreg pick`: two pictures, a panel, and a server that keeps every change.

import { Picture, toReference, toShown } from "./maps.js";
import { List, showCover, showHand, showNext } from "./panel.js";

const byId = (id) => document.getElementById(id);
const LINKS = { registration: "the registration", pairs: "the picked pairs", delivered: "as delivered", none: "not at all" };
const POLL = 2000; // ms between questions whether another window changed something

let state = null, job = null, chosen = null, linkName = "pairs", quiet = false, waiting = 0, down = false;
let queue = Promise.resolve();
const pictures = {};

async function ask(path, body) {
  const options = body && {
    method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body),
  };
  const answer = await fetch(path, { cache: "no-store", credentials: "same-origin", ...options });
  const content = answer.status === 204 ? null : answer.headers.get("content-type") === "application/json"
    ? await answer.json() : { error: await answer.text() };
  return { status: answer.status, content };
}

function warn(text) {
  byId("alert").textContent = text;
  byId("alert").hidden = !text;
}

function gone() {
  down = true;
  warn(`The server does not answer. All that was picked is saved${job ? ` in ${job.file}` : ""}; start meshreg pick again to go on.`);
}

// Changes go one after the other, each on the revision that the one before it made.
function change(what, values = {}) {
  waiting += 1;
  showSaved();
  queue = queue.then(async () => {
    try {
      const { status, content } = await ask("/api/change", { revision: state.revision, what, ...values });
      if (status === 200) { warn(""); down = false; take(content); }
      else if (status === 409) { take(content.state); warn(`${content.error} Here it is; please make your last change again.`); }
      else { draw(); warn(content.error); }
    } catch { draw(); gone(); }
    waiting -= 1;
    showSaved();
  });
  return queue;
}

async function poll() {
  if (!document.hidden && !waiting) {
    try {
      const { status, content } = await ask(`/api/state?since=${state.revision}`);
      if (status === 200 && !waiting) take(content);
      if (status === 403) gone();
      else if (down) { down = false; warn(""); }
    } catch { gone(); }
  }
  setTimeout(poll, POLL);
}

function take(next) {
  state = next;
  if (!state.pairs.some((pair) => pair.id === chosen)) chosen = null;
  showLinks();
  follow(pictures.reference);
  draw();
}

function openPair() { return state.pairs.find((pair) => !(pair.reference && pair.moving)) ?? null; }

function link() {
  if (linkName === "none") return null;
  return state.links[linkName] ?? state.links.delivered;
}

function across(from, place) {
  const by = link();
  if (!by) return null;
  return from.side === "reference" ? toShown(by, place) : toReference(by, place);
}

function other(picture) { return picture.side === "reference" ? pictures.moving : pictures.reference; }

function follow(leader) {
  if (quiet || !state || !pictures.moving) return;
  const place = across(leader, leader.centre());
  if (!place) return;
  quiet = true;
  other(leader).look(place, leader.view.getResolution(), leader.side === "reference" ? -link().angle : 0);
  if (leader.side === "moving") leader.view.setRotation(-link().angle);
  quiet = false;
}

function short(name) { return name.length > 24 ? `${name.slice(0, 23)}…` : name; }

function draw() {
  const open = openPair(), hinted = byId("hint").getAttribute("aria-pressed") === "true";
  for (const picture of Object.values(pictures)) {
    const marks = state.pairs.filter((pair) => pair[picture.side]).map((pair) => ({
      id: pair.id,
      text: pair.id === chosen && pair.name ? `${pair.id} ${short(pair.name)}` : `${pair.id}`,
      place: pair[picture.side],
      chosen: pair.id === chosen,
      look: pair === open ? "open" : pair.inlier === null ? "plain" : pair.inlier ? "agrees" : "wrong",
    }));
    const partner = open && !open[picture.side] && open[other(picture).side];
    picture.draw(marks, hinted && partner ? across(other(picture), partner) : null);
  }
  showNext(open, state.pairs, job.wanted);
  showHand(state.hand, state.turned);
  showCover(state.sectors, state.weak);
  list.show(state.pairs, chosen);
  byId("undo").disabled = !state.can_undo;
  byId("redo").disabled = !state.can_redo;
  showSaved();
}

function showSaved() {
  const box = byId("saved");
  box.classList.toggle("busy", waiting > 0);
  if (waiting) box.textContent = "Saving …";
  else if (state?.saved) box.textContent = `Saved in ${job.file} at ${new Date(1000 * state.saved).toLocaleTimeString("en-GB")}`;
  else box.textContent = state?.pairs.length ? `Resumed from ${job.file}` : `Will be saved in ${job.file}`;
}

function showLinks() {
  const names = Object.keys(LINKS).filter((name) => name !== "registration" || state.links.registration);
  const select = byId("link");
  if (select.options.length !== names.length) {
    select.replaceChildren(...names.map((name) => new Option(LINKS[name], name)));
  }
  select.value = linkName;
}

function choose(id) {
  chosen = chosen === id ? null : id;
  const pair = state.pairs.find((one) => one.id === chosen);
  if (pair) {
    const close = Math.min(pictures.reference.view.getResolution(), pictures.reference.cell / 2);
    quiet = true;
    for (const picture of Object.values(pictures)) {
      if (pair[picture.side]) { picture.look(pair[picture.side], close); picture.magnify(pair[picture.side]); }
    }
    quiet = false;
    if (!(pair.reference && pair.moving)) follow(pair.reference ? pictures.reference : pictures.moving);
  }
  draw();
  if (pair) list.rows.get(id)?.scrollIntoView({ block: "nearest" });
}

function pick(picture, [x, y]) {
  if (!picture.contains([x, y])) return;
  chosen = null;
  change("point", { side: picture.side, x, y });
}

const list = new List({
  choose,
  rename: (id, name) => change("name", { id, name }),
  drop: (id) => change("delete", { id }),
});

const on = {
  clicked: (picture, place, hit) => { if (hit !== undefined && !openPair()) choose(hit); else pick(picture, place); },
  dragged: (picture, id, [x, y]) => change("move", { id, side: picture.side, x, y }),
  pointed: (picture, place) => point(picture, place),
  viewed: (picture) => {
    follow(picture);
    if (document.activeElement === picture.element) point(picture, picture.centre());
  },
};

function point(picture, place) {
  const write = (one, at) => {
    byId(`${one.side}-pane`).querySelector(".place").textContent = at ? `E ${at[0].toFixed(3)}  N ${at[1].toFixed(3)}` : "";
  };
  picture.magnify(place);
  picture.clearLens(place);
  write(picture, place);
  const partner = across(picture, place);
  if (partner) { other(picture).magnify(partner); other(picture).clearLens(partner); }
  write(other(picture), partner);
}

function toggle(id, then) {
  const button = byId(id);
  button.setAttribute("aria-pressed", String(button.getAttribute("aria-pressed") !== "true"));
  then();
}

const showLens = () => {
  for (const picture of Object.values(pictures)) picture.showLens(byId("lens").getAttribute("aria-pressed") === "true");
};

function step(by) {
  if (!state.pairs.length) return;
  const at = state.pairs.findIndex((pair) => pair.id === chosen);
  const next = at < 0 ? (by > 0 ? 0 : state.pairs.length - 1) : (at + by + state.pairs.length) % state.pairs.length;
  chosen = null;
  choose(state.pairs[next].id);
}

function nextLink() {
  const names = [...byId("link").options].map((option) => option.value);
  setLink(names[(names.indexOf(linkName) + 1) % names.length]);
}

function setLink(name) {
  linkName = name;
  byId("link").value = name;
  follow(pictures.reference);
  draw();
}

const KEYS = {
  n: () => step(1), p: () => step(-1), l: nextLink,
  m: () => toggle("lens", showLens), e: () => toggle("hint", draw), "?": () => byId("help").showModal(),
  Delete: () => { if (chosen !== null) change("delete", { id: chosen }); },
  Escape: () => {
    const open = openPair();
    if (open) change("delete", { id: open.id });
    else if (chosen !== null) choose(chosen);
  },
};

function pressed(event) {
  const field = event.target.closest("input, select, dialog");
  if (field || byId("help").open) return;
  const command = event.ctrlKey || event.metaKey, key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (command && (key === "z" || key === "y")) {
    event.preventDefault();
    const what = key === "y" || event.shiftKey ? "redo" : "undo";
    if (state[`can_${what}`]) change(what);
  } else if (!command && !event.altKey && KEYS[key]) {
    event.preventDefault();
    KEYS[key]();
  } else if (key === "Enter" && event.target.classList.contains("map")) {
    event.preventDefault();
    const picture = pictures[event.target.id];
    pick(picture, picture.centre());
  }
}

async function start() {
  history.replaceState(null, "", "/"); // the token is spent; it need not stay in the address
  const asked = await ask("/api/job"), first = await ask("/api/state");
  if (asked.status !== 200 || first.status !== 200) { warn(asked.content.error); return; }
  job = asked.content;
  state = first.content;
  linkName = state.links.registration ? "registration" : "pairs";
  document.title = `${job.file} · meshreg`;
  for (const [side, about] of Object.entries(job.pictures)) {
    byId(`${side}-pane`).querySelector(".name").textContent = about.name;
    pictures[side] = new Picture(side, about, job.version, on);
  }
  quiet = true;
  for (const picture of Object.values(pictures)) picture.fit();
  quiet = false;
  byId("link").addEventListener("change", (event) => setLink(event.target.value));
  byId("undo").addEventListener("click", () => change("undo"));
  byId("redo").addEventListener("click", () => change("redo"));
  byId("lens").addEventListener("click", () => toggle("lens", showLens));
  byId("hint").addEventListener("click", () => toggle("hint", draw));
  byId("help-button").addEventListener("click", () => byId("help").showModal());
  document.addEventListener("keydown", pressed);
  take(state);
  for (const picture of Object.values(pictures)) picture.magnify(picture.centre());
  setTimeout(poll, POLL);
  // For tests and the curious: where a place is on the screen, and what the page knows.
  document.documentElement.dataset.ready = "";
  globalThis.meshregPick = { pictures, state: () => state, idle: () => queue, setLink };
}

start().catch(gone);
