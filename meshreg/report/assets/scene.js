"use strict";
// Both surfaces in 3-D: a small WebGL view, at most 100 000 triangles, nothing fetched.
(() => {
  const stage = document.querySelector(".stage.scene"), data = globalThis.meshregHeights;
  if (!stage || !data) return;
  const canvas = stage.querySelector("canvas"), sorry = stage.querySelector("p");
  const gl = canvas.getContext("webgl", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) {
    canvas.hidden = true;
    sorry.hidden = false;
    document.querySelector("[data-scene-tools]").hidden = true;
    return;
  }
  const VERTEX = `
    attribute vec3 place; attribute vec3 normal; attribute vec2 uv;
    uniform mat4 camera; uniform float stretch; uniform vec3 lift;
    varying vec3 facing; varying vec2 at;
    void main() {
      vec3 p = vec3(place.xy, place.z * stretch) + lift;
      facing = normalize(vec3(normal.xy * stretch, normal.z));
      at = uv;
      gl_Position = camera * vec4(p, 1.0);
    }`;
  const FRAGMENT = `
    precision mediump float;
    uniform sampler2D picture; uniform float textured; uniform vec3 tint;
    varying vec3 facing; varying vec2 at;
    void main() {
      float light = 0.35 + 0.75 * max(dot(normalize(facing), normalize(vec3(-0.5, 0.5, 0.9))), 0.0);
      vec4 seen = texture2D(picture, at);
      vec3 color = mix(tint, seen.rgb, textured * step(0.5, seen.a));
      gl_FragColor = vec4(color * mix(light, 0.55 + 0.5 * light, textured), 1.0);
    }`;
  function program() {
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    ["place", "normal", "uv"].forEach((name, k) => gl.bindAttribLocation(made, k, name));
    gl.linkProgram(made);
    gl.useProgram(made);
    return made;
  }
  const linked = program();
  const uniform = (name) => gl.getUniformLocation(linked, name);
  const at = Object.fromEntries(["camera", "stretch", "lift", "picture", "textured", "tint"].map((n) => [n, uniform(n)]));

  // 100 000 triangles for two surfaces: 25 000 quads each.
  const every = Math.max(1, Math.ceil(Math.sqrt(data.rows * data.cols / 25000)));
  const rows = Math.floor(data.rows / every), cols = Math.floor(data.cols / every);
  const span = Math.max(data.rows, data.cols) * data.cell;
  const [west, south, east, north] = data.texture || [data.west, data.north - data.rows * data.cell, data.west + data.cols * data.cell, data.north];

  function surface(grid) {
    const z = new Float32Array(rows * cols), places = new Float32Array(8 * rows * cols);
    for (let r = 0; r < rows; r++) {
      for (let c = 0; c < cols; c++) {
        let sum = 0, count = 0;
        for (let i = 0; i < every; i++) {
          for (let j = 0; j < every; j++) {
            const value = grid[(r * every + i) * data.cols + c * every + j];
            if (!Number.isNaN(value)) { sum += value; count += 1; }
          }
        }
        z[r * cols + c] = count ? sum / count : NaN;
      }
    }
    const step = every * data.cell, half = 0.5 * every;
    for (let r = 0; r < rows; r++) {
      for (let c = 0; c < cols; c++) {
        const k = r * cols + c, own = z[k];
        const near = (i, j) => {
          const value = z[clamp(i, 0, rows - 1) * cols + clamp(j, 0, cols - 1)];
          return Number.isNaN(value) ? own : value;
        };
        const x = (c * every + half) * data.cell, y = (r * every + half) * data.cell;
        const slope = [(near(r, c - 1) - near(r, c + 1)) / (2 * step), (near(r + 1, c) - near(r - 1, c)) / (2 * step)];
        places.set([
          (x - data.cols * data.cell / 2) / span, (data.rows * data.cell / 2 - y) / span, Number.isNaN(own) ? 0 : own / span,
          slope[0], slope[1], 1,
          (data.west + x - west) / (east - west), (north - (data.north - y)) / (north - south),
        ], 8 * k);
      }
    }
    const faces = new Uint16Array(6 * rows * cols);
    let n = 0;
    for (let r = 0; r + 1 < rows; r++) {
      for (let c = 0; c + 1 < cols; c++) {
        const k = r * cols + c, corners = [k, k + 1, k + cols, k + cols + 1];
        if (corners.some((q) => Number.isNaN(z[q]))) continue;
        faces.set([k, k + cols, k + 1, k + 1, k + cols, k + cols + 1], n);
        n += 6;
      }
    }
    const vertices = gl.createBuffer(), indices = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, vertices);
    gl.bufferData(gl.ARRAY_BUFFER, places, gl.STATIC_DRAW);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, indices);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces.subarray(0, n), gl.STATIC_DRAW);
    return { vertices, indices, count: n };
  }
  const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

  const surfaces = {}, textures = {};
  function texture(name) {
    if (textures[name]) return textures[name];
    const image = document.querySelector(`#mosaics img[data-stage="${name}"]`);
    const made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    if (image && image.complete && image.naturalWidth) {
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
      textures[name] = made;
    } else {
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
      if (image) image.addEventListener("load", draw, { once: true });
    }
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.LINEAR);
    return made;
  }

  const home = () => ({ turn: -0.5, tilt: 0.85, far: 1.85, x: 0.02, y: -0.04 });
  let eye = home();
  function camera() {
    const aspect = canvas.width / canvas.height, f = 1 / Math.tan(0.36) * Math.min(1, aspect);
    const [ct, st, ck, sk] = [Math.cos(eye.turn), Math.sin(eye.turn), Math.cos(eye.tilt), Math.sin(eye.tilt)];
    // rows of the view: right, up, backward
    const right = [ct, st, 0], back = [st * ck, -ct * ck, sk], up = [-st * sk, ct * sk, ck];
    const target = [eye.x, eye.y, 0], dot = (a) => a[0] * target[0] + a[1] * target[1];
    const near = 0.02, long = 20, a = (long + near) / (near - long), b = 2 * long * near / (near - long);
    const view = [[...right, -dot(right)], [...up, -dot(up)], [...back, -dot(back) - eye.far]];
    const rowsOf = [view[0].map((v) => v * f / aspect), view[1].map((v) => v * f), view[2].map((v, k) => v * a + (k === 3 ? b : 0)), view[2].map((v) => -v)];
    return new Float32Array([0, 1, 2, 3].flatMap((c) => rowsOf.map((row) => row[c])));
  }
  const picked = (name) => document.querySelector(`[data-scene-tools] input[name="${name}"]:checked`)?.value;
  const stretcher = document.getElementById("stretch");
  let asked = false;
  function draw() { if (!asked) { asked = true; requestAnimationFrame(paint); } }
  function paint() {
    asked = false;
    const dense = Math.min(devicePixelRatio || 1, 2);
    canvas.width = Math.max(1, Math.round(stage.clientWidth * dense));
    canvas.height = Math.max(1, Math.round(stage.clientHeight * dense));
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.uniformMatrix4fv(at.camera, false, camera());
    gl.uniform1f(at.stretch, Number(stretcher.value));
    stretcher.nextElementSibling.textContent = stretcher.value;
    const looks = { reference: [0.34, 0.66, 0.9], before: [0.93, 0.56, 0.24], after: [0.93, 0.56, 0.24] };
    const moving = picked("scene-stage") || "before", show = picked("scene-show"), photo = picked("scene-look") === "photo";
    let triangles = 0;
    for (const name of ["reference", moving]) {
      if (!data.grids[name] || (show !== "both" && (show === "reference") !== (name === "reference"))) continue;
      const made = surfaces[name] || (surfaces[name] = surface(data.grids[name]));
      gl.bindTexture(gl.TEXTURE_2D, texture(name));
      gl.uniform1f(at.textured, photo ? 1 : 0);
      gl.uniform3fv(at.tint, looks[name]);
      gl.uniform3f(at.lift, 0, 0, 0);
      gl.bindBuffer(gl.ARRAY_BUFFER, made.vertices);
      [[3, 0], [3, 12], [2, 24]].forEach(([size, offset], k) => {
        gl.enableVertexAttribArray(k);
        gl.vertexAttribPointer(k, size, gl.FLOAT, false, 32, offset);
      });
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, made.indices);
      gl.drawElements(gl.TRIANGLES, made.count, gl.UNSIGNED_SHORT, 0);
      triangles += made.count / 3;
    }
    stage.dataset.triangles = String(triangles);
    document.getElementById("scene-count").textContent = `${triangles.toLocaleString("en")} triangles`;
  }
  const fingers = new Map();
  stage.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    stage.setPointerCapture(event.pointerId);
  });
  const slide = (dx, dy) => {
    const k = eye.far / stage.clientHeight * 0.75, [c, s] = [Math.cos(eye.turn), Math.sin(eye.turn)];
    eye.x -= k * (dx * c + dy * s);
    eye.y -= k * (dx * s - dy * c);
  };
  stage.addEventListener("pointermove", (event) => {
    const old = fingers.get(event.pointerId);
    if (!old) return;
    const now = [event.clientX, event.clientY], dx = now[0] - old[0], dy = now[1] - old[1];
    if (fingers.size === 2) {
      const rest = [...fingers].find(([id]) => id !== event.pointerId)[1];
      const apart = (a) => Math.max(Math.hypot(a[0] - rest[0], a[1] - rest[1]), 1);
      eye.far = clamp(eye.far * apart(old) / apart(now), 0.15, 6);
      slide(dx / 2, dy / 2);
    } else if (event.shiftKey || event.buttons & 2) {
      slide(dx, dy);
    } else {
      eye.turn -= 0.007 * dx;
      eye.tilt = clamp(eye.tilt + 0.007 * dy, 0.05, 1.57);
    }
    fingers.set(event.pointerId, now);
    draw();
  });
  for (const kind of ["pointerup", "pointercancel"]) stage.addEventListener(kind, (event) => fingers.delete(event.pointerId));
  stage.addEventListener("contextmenu", (event) => event.preventDefault());
  stage.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.metaKey && document.activeElement !== stage) return;
    event.preventDefault();
    eye.far = clamp(eye.far * 1.0012 ** event.deltaY, 0.15, 6);
    draw();
  }, { passive: false });
  stage.addEventListener("keydown", (event) => {
    const turns = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.08], ArrowDown: [0, -0.08] }[event.key];
    if (turns) { eye.turn += turns[0]; eye.tilt = clamp(eye.tilt + turns[1], 0.05, 1.57); }
    else if (event.key === "+" || event.key === "=") eye.far = clamp(eye.far / 1.2, 0.15, 6);
    else if (event.key === "-") eye.far = clamp(eye.far * 1.2, 0.15, 6);
    else if (event.key === "0") eye = home();
    else return;
    event.preventDefault();
    draw();
  });
  for (const input of document.querySelectorAll("[data-scene-tools] input")) input.addEventListener("input", draw);
  document.querySelector("[data-scene-home]").addEventListener("click", () => { eye = home(); draw(); });
  canvas.addEventListener("webglcontextlost", () => { canvas.hidden = true; sorry.hidden = false; });
  // Nothing is uploaded before the reader comes near.
  new IntersectionObserver((seen, watch) => {
    if (!seen.some((entry) => entry.isIntersecting)) return;
    watch.disconnect();
    new ResizeObserver(draw).observe(stage);
    draw();
  }, { rootMargin: "300px" }).observe(stage);
})();
