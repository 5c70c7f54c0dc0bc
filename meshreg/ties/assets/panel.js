// The panel beside the pictures: what to do next, the hand registration, where pairs are missing, the list.

const byId = (id) => document.getElementById(id);
const metres = (value, digits = 3) => `${value.toFixed(digits)} m`;
const signed = (value) => `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(3)} m`;

export function showNext(open, pairs, wanted) {
  const complete = pairs.filter((pair) => pair.reference && pair.moving).length;
  let text = "Click something that both pictures show, in either one.";
  if (open) {
    text = `Pair ${open.id}: now click the same thing in the ${open.reference ? "moving" : "reference"} picture.`;
  } else if (complete >= wanted) {
    text = `${complete} pairs: as many as the paper's authors picked at a site. More do no harm.`;
  } else if (complete) {
    text += ` ${wanted - complete} more make ${wanted}, as in the paper.`;
  }
  byId("next").textContent = text;
  for (const side of ["reference", "moving"]) {
    byId(`${side}-pane`).classList.toggle("wanted", Boolean(open) && !open[side]);
  }
}

export function showHand(hand, turned) {
  byId("hand").hidden = !hand;
  byId("hand-none").hidden = Boolean(hand);
  const note = byId("hand-note");
  note.textContent = "";
  note.classList.remove("bad");
  if (!hand) return;
  for (const [axis, k] of [["east", 0], ["north", 1]]) {
    const small = document.createElement("small");
    small.textContent = `± ${metres(hand.sigma[k])}`;
    byId(`hand-${axis}`).replaceChildren(signed(hand[axis]), small);
  }
  byId("hand-inliers").textContent = `${hand.inliers} of ${hand.pairs}`;
  byId("hand-residual").textContent = metres(hand.residual);
  byId("hand-residual-inliers").textContent = metres(hand.residual_inliers);
  note.textContent = `Add to the moving survey. RANSAC of ${hand.draws.toLocaleString("en")} draws of `
    + `${hand.sample}, within ${hand.radius} m.`;
  if (turned !== null) {
    note.textContent += ` The pairs are turned by ${turned.toFixed(2)}° about their middle first, as they themselves ask.`;
  }
  if (hand.contradictory) {
    note.textContent = `Only ${hand.inliers} of ${hand.pairs} pairs agree within ${hand.radius} m: `
      + "look at those marked, or the surveys are bent against each other.";
    note.classList.add("bad");
  }
}

export function showCover(sectors, weak) {
  byId("sectors").replaceChildren(...sectors.map((sector) => {
    const box = document.createElement("span");
    box.textContent = sector.pairs || "";
    box.title = `${sector.name}: ${sector.pairs} pairs, ${Math.round(100 * sector.share)} % of the common ground`;
    box.className = sector.pairs ? "has" : weak.includes(sector.name) ? "weak" : sector.share ? "" : "none";
    return box;
  }));
  let text = "Both surveys show no common ground here.";
  if (sectors.length) text = "Pairs stand in every part of the common ground.";
  if (weak.length) {
    const list = weak.length > 1 ? `${weak.slice(0, -1).join(", ")} and ${weak.at(-1)}` : weak[0];
    text = weak.length === 9 ? "No pairs yet." : `No pairs in the ${list}.`;
  }
  byId("weak").textContent = text;
}

export class List {
  // `on` holds what to call: choose(id), rename(id, name), drop(id)
  constructor(on) {
    this.on = on;
    this.body = byId("pairs");
    this.rows = new Map();
  }

  show(pairs, chosen) {
    const seen = new Set(pairs.map((pair) => pair.id));
    for (const [id, row] of this.rows) {
      if (!seen.has(id)) { row.remove(); this.rows.delete(id); }
    }
    for (const pair of pairs) this.fill(this.row(pair.id), pair, pair.id === chosen);
    const complete = pairs.filter((pair) => pair.reference && pair.moving).length;
    byId("count").textContent = complete ? `(${complete})` : "";
  }

  row(id) {
    if (this.rows.has(id)) return this.rows.get(id);
    const row = document.createElement("tr");
    row.dataset.id = id;
    const go = Object.assign(document.createElement("button"), {
      className: "go", textContent: id, title: "Show this pair",
    });
    const name = Object.assign(document.createElement("input"), { maxLength: 80, placeholder: "name" });
    name.setAttribute("aria-label", `Name of pair ${id}`);
    const drop = Object.assign(document.createElement("button"), {
      className: "drop", textContent: "✕", title: "Remove this pair",
    });
    drop.setAttribute("aria-label", `Remove pair ${id}`);
    const residual = Object.assign(document.createElement("td"), { className: "residual" });
    for (const part of [go, name, null, drop]) {
      const cell = part ? document.createElement("td") : residual;
      if (part) cell.append(part);
      row.append(cell);
    }
    go.addEventListener("click", () => this.on.choose(id));
    drop.addEventListener("click", () => this.on.drop(id));
    name.addEventListener("change", () => this.on.rename(id, name.value));
    name.addEventListener("keydown", (event) => { if (event.key === "Enter") name.blur(); });
    this.rows.set(id, row);
    this.body.append(row);
    return row;
  }

  fill(row, pair, chosen) {
    const name = row.querySelector("input"), residual = row.querySelector(".residual");
    if (document.activeElement !== name) name.value = pair.name;
    const open = !(pair.reference && pair.moving);
    const known = pair.residual !== null;
    residual.textContent = open ? "open" : known ? `${pair.inlier ? "" : "✗ "}${metres(pair.residual)}` : "–";
    residual.title = known && !pair.inlier ? "disagrees with the others" : "";
    row.className = [
      chosen && "chosen", open && "open", known && (pair.inlier ? "agrees" : "wrong"),
    ].filter(Boolean).join(" ");
  }
}
