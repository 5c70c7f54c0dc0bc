"use strict";
// A line over the relief that the reader drags, and the heights of both surveys along it.
(() => {
  const source = document.getElementById("heights");
  if (!source) return;
  const data = JSON.parse(source.textContent);
  const NONE = -32768;
  const grids = {};
  for (const [name, text] of Object.entries(data.grids)) {
    const bytes = atob(text), grid = new Float32Array(bytes.length / 2);
    for (let k = 0; k < grid.length; k++) {
      // two bytes, the lower one first, to a signed number
      const level = ((bytes.charCodeAt(2 * k + 1) << 24) >> 16) | bytes.charCodeAt(2 * k);
      grid[k] = level === NONE ? NaN : level * data.step;
    }
    grids[name] = grid;
  }
  globalThis.meshregHeights = { ...data, grids };

  const profile = document.getElementById("profile");
  if (!profile) return;
  const { rows, cols, cell } = data;
  const wide = cols * cell, tall = rows * cell;
  const svg = (tag, attributes, parent) => {
    const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    if (parent) parent.append(node);
    return node;
  };
  const write = (parent, text, attributes) => { svg("text", attributes, parent).textContent = text; };
  const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

  function heightAt(grid, x, y) {
    const c = x / cell - 0.5, r = y / cell - 0.5;
    const c0 = clamp(Math.floor(c), 0, cols - 2), r0 = clamp(Math.floor(r), 0, rows - 2);
    const u = clamp(c - c0, 0, 1), v = clamp(r - r0, 0, 1), k = r0 * cols + c0;
    return (1 - v) * ((1 - u) * grid[k] + u * grid[k + 1]) + v * ((1 - u) * grid[k + cols] + u * grid[k + cols + 1]);
  }
  // The column that both surveys see most of, from its north end to its south end.
  function start() {
    const other = grids.after || grids.before || grids.reference;
    let best = [-1, 0.5 * wide, 0, tall];
    for (let c = 0; c < cols; c++) {
      let count = 0, first = -1, last = 0;
      for (let r = 0; r < rows; r++) {
        const k = r * cols + c;
        if (Number.isNaN(grids.reference[k] + other[k])) continue;
        count += 1;
        if (first < 0) first = r;
        last = r;
      }
      const score = count - 0.05 * Math.abs(c - cols / 2);
      if (count && score > best[0]) best = [score, (c + 0.5) * cell, (first + 0.5) * cell, (last + 0.5) * cell];
    }
    return [{ x: best[1], y: best[3] }, { x: best[1], y: best[2] }];
  }
  const ends = start();

  const overlays = [...document.querySelectorAll("[data-section]")].map((box) => {
    const layer = svg("svg", { viewBox: `0 0 ${wide} ${tall}`, preserveAspectRatio: "none" }, box);
    const parts = {
      hit: svg("line", { class: "hit", stroke: "transparent" }, layer),
      under: svg("line", { stroke: "#fff", "pointer-events": "none" }, layer),
      line: svg("line", { stroke: "#111", "pointer-events": "none" }, layer),
      grips: ["A", "B"].map((name) => {
        const grip = svg("g", { class: "grip", tabindex: 0, role: "button",
          "aria-label": `End ${name} of the section; move it with the arrow keys` }, layer);
        svg("circle", { fill: "#fff", stroke: "#111" }, grip);
        const letter = svg("text", { "text-anchor": "middle", fill: "#111" }, grip);
        letter.textContent = name;
        letter.style.fill = "#111";
        return grip;
      }),
    };
    const place = (event) => {
      const at = layer.getBoundingClientRect();
      return { x: clamp((event.clientX - at.left) / at.width, 0, 1) * wide, y: clamp((event.clientY - at.top) / at.height, 0, 1) * tall };
    };
    let held = null, from = null;
    const grab = (which) => (event) => {
      held = which;
      from = place(event);
      layer.setPointerCapture(event.pointerId);
      event.preventDefault();
    };
    parts.hit.addEventListener("pointerdown", grab("line"));
    parts.grips.forEach((grip, k) => {
      grip.addEventListener("pointerdown", grab(k));
      grip.addEventListener("keydown", (event) => {
        const step = (event.shiftKey ? 10 : 1) * cell;
        const move = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] }[event.key];
        if (!move) return;
        event.preventDefault();
        ends[k] = { x: clamp(ends[k].x + move[0], 0, wide), y: clamp(ends[k].y + move[1], 0, tall) };
        draw();
      });
    });
    layer.addEventListener("pointermove", (event) => {
      if (held === null) return;
      const now = place(event);
      if (held === "line") {
        const low = (key, size) => clamp(now[key] - from[key], -Math.min(ends[0][key], ends[1][key]), size - Math.max(ends[0][key], ends[1][key]));
        const dx = low("x", wide), dy = low("y", tall);
        for (const end of ends) { end.x += dx; end.y += dy; }
        from = now;
      } else {
        ends[held] = now;
      }
      draw();
    });
    const drop = () => { held = null; };
    layer.addEventListener("pointerup", drop);
    layer.addEventListener("pointercancel", drop);
    return { layer, parts };
  });

  function drawLine() {
    for (const { layer, parts } of overlays) {
      const metre = wide / Math.max(layer.clientWidth, 1); // metres per screen pixel
      const line = { x1: ends[0].x, y1: ends[0].y, x2: ends[1].x, y2: ends[1].y };
      const thick = { hit: 22, under: 4, line: 1.8 };
      for (const [name, width] of Object.entries(thick)) {
        for (const [key, value] of Object.entries(line)) parts[name].setAttribute(key, value);
        parts[name].setAttribute("stroke-width", width * metre);
      }
      parts.grips.forEach((grip, k) => {
        const [circle, letter] = grip.children;
        circle.setAttribute("cx", ends[k].x);
        circle.setAttribute("cy", ends[k].y);
        circle.setAttribute("r", 11 * metre);
        circle.setAttribute("stroke-width", 1.6 * metre);
        letter.setAttribute("x", ends[k].x);
        letter.setAttribute("y", ends[k].y + 4.4 * metre);
        letter.style.fontSize = `${12.5 * metre}px`;
      });
    }
  }

  function ticks(low, high, count) {
    const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((k) => k * power).find((s) => s >= rough);
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    const found = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push([k * step, (k * step + 0).toFixed(digits).replace("-", "\u2212")]);
    return found;
  }

  let last = null;
  function drawProfile() {
    const w = profile.clientWidth, h = profile.clientHeight;
    if (!w) return;
    profile.setAttribute("viewBox", `0 0 ${w} ${h}`);
    profile.replaceChildren();
    const box = { l: 54, r: w - 10, t: 12, b: h - 40 };
    const length = Math.hypot(ends[1].x - ends[0].x, ends[1].y - ends[0].y);
    const count = Math.round(clamp(1.5 * length / cell, 40, 900));
    const names = ["reference", "before", "after"].filter((name) => grids[name]);
    const along = Array.from({ length: count + 1 }, (_, k) => k / count);
    const values = Object.fromEntries(names.map((name) => [name, along.map((t) => data.middle + heightAt(grids[name],
      ends[0].x + t * (ends[1].x - ends[0].x), ends[0].y + t * (ends[1].y - ends[0].y)))]));
    const known = names.flatMap((name) => values[name]).filter(Number.isFinite);
    let low = Math.min(...known), high = Math.max(...known);
    if (!known.length) [low, high] = [data.middle - 1, data.middle + 1];
    const pad = Math.max(0.08 * (high - low), 0.01);
    [low, high] = [low - pad, high + pad];
    const px = (t) => box.l + t * (box.r - box.l), py = (z) => box.b - (z - low) / (high - low) * (box.b - box.t);
    for (const [z, text] of ticks(low, high, 5)) {
      svg("line", { class: "grid", x1: box.l, x2: box.r, y1: py(z), y2: py(z) }, profile);
      write(profile, text, { class: "tick", x: box.l - 7, y: py(z) + 4, "text-anchor": "end" });
    }
    for (const [d, text] of length > 0 ? ticks(0, length, Math.max(3, Math.round(w / 110))) : []) {
      svg("line", { class: "axis", x1: px(d / length), x2: px(d / length), y1: box.b, y2: box.b + 4 }, profile);
      write(profile, text, { class: "tick", x: px(d / length), y: box.b + 17, "text-anchor": "middle" });
    }
    svg("line", { class: "axis", x1: box.l, x2: box.r, y1: box.b, y2: box.b }, profile);
    write(profile, "metres along the line, from A to B", { x: (box.l + box.r) / 2, y: h - 6, "text-anchor": "middle" });
    write(profile, "height [m]", { x: 0, y: 0, transform: `translate(12 ${(box.t + box.b) / 2}) rotate(-90)`, "text-anchor": "middle" });
    for (const name of ["before", "reference", "after"].filter((n) => values[n])) {
      let path = "", pen = false;
      values[name].forEach((z, k) => {
        if (Number.isFinite(z)) path += `${pen ? "L" : "M"}${px(along[k]).toFixed(1)} ${py(z).toFixed(1)}`;
        pen = Number.isFinite(z);
      });
      svg("path", { class: `line ${name}`, d: path || "M0 0" }, profile);
    }
    const hair = svg("line", { class: "axis", y1: box.t, y2: box.b, visibility: "hidden" }, profile);
    last = { box, values, count, length, hair };
  }
  const readout = document.getElementById("profile-value");
  const label = { reference: "reference", before: "before", after: "after" };
  profile.addEventListener("pointermove", (event) => {
    if (!last) return;
    const t = clamp((event.clientX - profile.getBoundingClientRect().left - last.box.l) / (last.box.r - last.box.l), 0, 1);
    const k = Math.round(t * last.count), x = last.box.l + k / last.count * (last.box.r - last.box.l);
    last.hair.setAttribute("x1", x);
    last.hair.setAttribute("x2", x);
    last.hair.setAttribute("visibility", "visible");
    readout.textContent = [`${(k / last.count * last.length).toFixed(2)} m`, ...Object.entries(last.values)
      .filter(([, z]) => Number.isFinite(z[k])).map(([name, z]) => `${label[name]} ${z[k].toFixed(3)} m`)].join(", ");
  });
  profile.addEventListener("pointerleave", () => {
    if (last) last.hair.setAttribute("visibility", "hidden");
    readout.textContent = "";
  });
  function draw() { drawLine(); drawProfile(); }
  new ResizeObserver(draw).observe(profile);
  for (const { layer } of overlays) new ResizeObserver(drawLine).observe(layer);
  draw();
})();
