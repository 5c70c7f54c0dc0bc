"use strict";
// Theme, the two-picture viewers (swipe, flicker, zoom, pan) and the copy button.
(() => {
  const root = document.documentElement;
  root.classList.add("js");

  const theme = document.getElementById("theme");
  const dark = () => root.dataset.theme
    ? root.dataset.theme === "dark"
    : matchMedia("(prefers-color-scheme: dark)").matches;
  const named = () => { theme.textContent = dark() ? "Light" : "Dark"; };
  theme.addEventListener("click", () => {
    root.dataset.theme = dark() ? "light" : "dark";
    named();
    document.dispatchEvent(new Event("themechange"));
  });
  named();

  const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

  function viewer(box) {
    const stage = box.querySelector(".stage"), world = box.querySelector(".world");
    const handle = box.querySelector(".handle"), readout = box.querySelector("output");
    const scale = box.querySelector(".scale"), flicker = box.querySelector("[data-flicker]");
    const left = box.querySelector(".tag.left"), right = box.querySelector(".tag.right");
    const pictures = Object.fromEntries([...world.querySelectorAll("img")].map((i) => [i.dataset.stage, i]));
    const metres = { w: Number(box.dataset.width), h: Number(box.dataset.height) };
    const corner = { west: Number(box.dataset.west), north: Number(box.dataset.north) };
    let z = 1, tx = 0, ty = 0, swipe = 0.5, fit = { w: 1, h: 1 };
    let stageName = pictures.after ? "after" : "before";
    let shown = "swipe", timer = 0;
    const names = { before: box.dataset.before, after: box.dataset.after };

    function draw() {
      const w = stage.clientWidth, h = stage.clientHeight;
      tx = z * fit.w <= w ? (w - z * fit.w) / 2 : clamp(tx, w - z * fit.w, 0);
      ty = z * fit.h <= h ? (h - z * fit.h) / 2 : clamp(ty, h - z * fit.h, 0);
      world.style.width = `${fit.w}px`;
      world.style.height = `${fit.h}px`;
      world.style.transform = `translate(${tx}px, ${ty}px) scale(${z})`;
      world.classList.toggle("near", pictures.reference.naturalWidth > 0
        && z * fit.w / pictures.reference.naturalWidth > 4);
      stage.classList.toggle("zoomed", z > 1.001);
      const cut = clamp((swipe * w - tx) / z, 0, fit.w);
      const swiping = shown === "swipe";
      pictures.reference.style.clipPath = swiping ? `inset(0 ${fit.w - cut}px 0 0)` : "";
      pictures.reference.style.visibility = shown === "moving" ? "hidden" : "";
      for (const name of ["before", "after"]) {
        if (!pictures[name]) continue;
        pictures[name].style.clipPath = swiping ? `inset(0 0 0 ${cut}px)` : "";
        pictures[name].style.visibility = name === stageName && shown !== "reference" ? "" : "hidden";
      }
      handle.style.left = `${swipe * w}px`;
      handle.hidden = !swiping;
      handle.setAttribute("aria-valuenow", String(Math.round(100 * swipe)));
      left.hidden = shown === "moving";
      right.hidden = shown === "reference";
      right.textContent = names[stageName];
      stage.dataset.shown = shown;
      ruler();
    }
    function ruler() {
      const perPixel = metres.w / (fit.w * z), most = 0.28 * stage.clientWidth * perPixel;
      const power = 10 ** Math.floor(Math.log10(most));
      const length = [5, 2, 1].find((k) => k * power <= most) * power;
      scale.firstElementChild.style.width = `${length / perPixel}px`;
      scale.lastChild.textContent = length >= 1 ? `${length} m` : `${Number((100 * length).toPrecision(2))} cm`;
    }
    function resize() {
      const w = stage.clientWidth;
      stage.style.height = `${clamp(w * metres.h / metres.w, 180, Math.max(0.72 * innerHeight, 260))}px`;
      const k = Math.min(w / metres.w, stage.clientHeight / metres.h);
      fit = { w: metres.w * k, h: metres.h * k };
      draw();
    }
    function zoom(factor, x = stage.clientWidth / 2, y = stage.clientHeight / 2) {
      const next = clamp(z * factor, 1, 40);
      tx = x - (x - tx) * next / z;
      ty = y - (y - ty) * next / z;
      z = next;
      draw();
    }
    function reset() { z = 1; swipe = 0.5; draw(); }
    function pan(dx, dy) { tx += dx; ty += dy; draw(); }
    function stop() { clearInterval(timer); timer = 0; flicker.setAttribute("aria-pressed", "false"); }
    function other() { shown = shown === "reference" ? "moving" : "reference"; draw(); }
    function flick() {
      if (timer) { stop(); shown = "swipe"; draw(); return; }
      other();
      flicker.setAttribute("aria-pressed", "true");
      // slower than three changes a second: nobody is harmed by that
      timer = setInterval(other, 700);
    }
    function choose(name) {
      if (!pictures[name]) return;
      stageName = name;
      const input = box.querySelector(`input[value="${name}"]`);
      if (input) input.checked = true;
      draw();
    }

    for (const input of box.querySelectorAll("input[type=radio]")) {
      input.addEventListener("change", () => choose(input.value));
    }
    flicker.addEventListener("click", flick);
    const bright = box.querySelector("[data-bright]");
    if (bright) bright.addEventListener("click", () => {
      bright.setAttribute("aria-pressed", String(stage.classList.toggle("bright")));
    });
    const acts = { in: () => zoom(1.5), out: () => zoom(1 / 1.5), reset };
    for (const button of box.querySelectorAll("[data-act]")) {
      button.addEventListener("click", acts[button.dataset.act]);
    }
    const slide = (event) => {
      swipe = clamp((event.clientX - stage.getBoundingClientRect().left) / stage.clientWidth, 0, 1);
      draw();
    };
    handle.addEventListener("pointerdown", (event) => {
      handle.setPointerCapture(event.pointerId);
      event.stopPropagation();
      slide(event);
    });
    handle.addEventListener("pointermove", (event) => {
      if (handle.hasPointerCapture(event.pointerId)) slide(event);
    });
    handle.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -0.02, ArrowRight: 0.02, PageDown: -0.1, PageUp: 0.1, Home: -1, End: 1 }[event.key];
      if (step === undefined) return;
      swipe = clamp(swipe + step, 0, 1);
      draw();
      event.preventDefault();
      event.stopPropagation();
    });

    const fingers = new Map();
    stage.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      if (event.pointerType === "mouse" || z > 1.001) stage.setPointerCapture(event.pointerId);
      stage.classList.add("dragging");
    });
    stage.addEventListener("pointermove", (event) => {
      tell(event);
      const last = fingers.get(event.pointerId);
      if (!last) return;
      const now = [event.clientX, event.clientY];
      if (fingers.size === 1) pan(now[0] - last[0], now[1] - last[1]);
      if (fingers.size === 2) {
        const rest = [...fingers].find(([id]) => id !== event.pointerId)[1];
        const apart = (a) => Math.hypot(a[0] - rest[0], a[1] - rest[1]);
        const place = stage.getBoundingClientRect();
        zoom(apart(now) / Math.max(apart(last), 1), (now[0] + rest[0]) / 2 - place.left, (now[1] + rest[1]) / 2 - place.top);
      }
      fingers.set(event.pointerId, now);
    });
    for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) {
      stage.addEventListener(kind, (event) => {
        fingers.delete(event.pointerId);
        if (!fingers.size) stage.classList.remove("dragging");
      });
    }
    stage.addEventListener("pointerleave", () => { readout.textContent = ""; });
    stage.addEventListener("dblclick", (event) => {
      const place = stage.getBoundingClientRect();
      zoom(2, event.clientX - place.left, event.clientY - place.top);
    });
    stage.addEventListener("wheel", (event) => {
      // A bare wheel scrolls the page; over a focused picture, or with Ctrl, it zooms.
      if (!event.ctrlKey && !event.metaKey && !stage.contains(document.activeElement)) return;
      event.preventDefault();
      const place = stage.getBoundingClientRect();
      zoom(1.0015 ** -event.deltaY, event.clientX - place.left, event.clientY - place.top);
    }, { passive: false });
    stage.addEventListener("keydown", (event) => {
      const moves = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] };
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (moves[event.key]) pan(...moves[event.key]);
      else if (event.key === "+" || event.key === "=") zoom(1.5);
      else if (event.key === "-") zoom(1 / 1.5);
      else if (event.key === "0") reset();
      else if (event.key === "f") flick();
      else if (event.key === " ") { stop(); other(); }
      else if (event.key === "s" || event.key === "Escape") { stop(); shown = "swipe"; draw(); }
      else if (event.key === "b") choose("before");
      else if (event.key === "a") choose("after");
      else return;
      event.preventDefault();
    });
    function tell(event) {
      const place = stage.getBoundingClientRect();
      const x = (event.clientX - place.left - tx) / z / fit.w, y = (event.clientY - place.top - ty) / z / fit.h;
      readout.textContent = x < 0 || x > 1 || y < 0 || y > 1 ? ""
        : `east ${(corner.west + x * metres.w).toFixed(2)} m, north ${(corner.north - y * metres.h).toFixed(2)} m`;
    }
    new ResizeObserver(resize).observe(stage.parentElement);
    resize();
  }
  for (const box of document.querySelectorAll("[data-viewer]")) viewer(box);

  for (const button of document.querySelectorAll("[data-copy]")) {
    button.addEventListener("click", async () => {
      const text = document.getElementById(button.dataset.copy);
      const range = document.createRange();
      range.selectNodeContents(text);
      getSelection().removeAllRanges();
      getSelection().addRange(range);
      try {
        await navigator.clipboard.writeText(text.textContent);
        button.textContent = "Copied";
      } catch {
        button.textContent = "Selected: copy with Ctrl+C";
      }
    });
  }
  addEventListener("beforeprint", () => {
    for (const part of document.querySelectorAll("details[data-print]")) part.open = true;
  });
})();
