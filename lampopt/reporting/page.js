"use strict";
(() => {
  const all = (what, where = document) => [...where.querySelectorAll(what)];
  const one = (what) => document.querySelector(what);
  const config = JSON.parse(one("#config").textContent);

  // The viewer: parallel projection, the light moves with the eye, as in the pictures.
  function viewer(canvas) {
    const gl = canvas.getContext("webgl2", { antialias: true, alpha: true, preserveDrawingBuffer: true });
    if (!gl) return null;
    const program = linked(gl, `#version 300 es
      layout(location = 0) in vec3 place; layout(location = 1) in vec4 look; layout(location = 2) in float off;
      uniform mat3 turn; uniform vec2 size, shift; uniform float grow;
      out vec3 normal; out float sky, apart;
      void main() {
        vec3 seen = turn * ((place * 2.0 - 1.0) * grow);
        gl_Position = vec4((seen.xy + shift) / size, -seen.z / 8.0, 1.0);
        normal = turn * look.xyz; sky = look.w; apart = off;
      }`, `#version 300 es
      precision highp float;
      in vec3 normal; in float sky, apart;
      uniform vec3 plain, below, level, above; uniform bool heat;
      out vec4 result;
      void main() {
        vec3 n = normalize(gl_FrontFacing ? normal : -normal);
        vec3 key = normalize(vec3(-0.42, 0.62, 0.66)), fill = normalize(vec3(0.8, 0.05, 0.6));
        vec3 half_way = normalize(key + vec3(0, 0, 1));
        float t = clamp(apart, -1.0, 1.0);
        vec3 colour = heat ? mix(level, t < 0.0 ? below : above, abs(t)) : plain;
        float light = (0.40 + 0.14 * n.y) * sky + 0.52 * max(dot(n, key), 0.0) * (0.45 + 0.55 * sky)
          + 0.16 * max(dot(n, fill), 0.0) * sky;
        float shine = 0.10 * pow(max(dot(n, half_way), 0.0), 28.0) * sky;
        result = vec4(pow(min(pow(colour, vec3(2.2)) * light * 1.28 + shine, 1.0), vec3(1.0 / 2.2)), 1.0);
      }`);
    gl.useProgram(program);
    gl.enable(gl.DEPTH_TEST);
    const at = (name) => gl.getUniformLocation(program, name);
    const colour = (name, rgb) => gl.uniform3fv(at(name), rgb.map((v) => v / 255));
    colour("plain", config.plain);
    ["below", "level", "above"].forEach((name, i) => colour(name, config.colours[i]));
    const made = new Map();
    const state = { key: null, heat: false, azimuth: 0, height: 0, zoom: 1, shift: [0, 0] };

    function mesh(key) {
      if (made.has(key)) return made.get(key);
      const source = document.getElementById("m-" + key);
      if (!source) return null;
      const text = atob(source.textContent), bytes = new Uint8Array(text.length);
      for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
      const V = +source.dataset.vertices, F = +source.dataset.faces, wide = V > 65536;
      const cuts = [6 * V, 3 * F * (wide ? 4 : 2), 4 * V, source.dataset.distances === "1" ? V : 0];
      let from = 0;
      const [place, corners, look, off] = cuts.map((n) => bytes.slice(from, (from += n)));
      const array = gl.createVertexArray();
      gl.bindVertexArray(array);
      const filled = (target, data) => { gl.bindBuffer(target, gl.createBuffer()); gl.bufferData(target, data, gl.STATIC_DRAW); };
      const given = (index, count, type) => { gl.enableVertexAttribArray(index); gl.vertexAttribPointer(index, count, type, true, 0, 0); };
      filled(gl.ARRAY_BUFFER, place); given(0, 3, gl.UNSIGNED_SHORT);
      filled(gl.ARRAY_BUFFER, look); given(1, 4, gl.BYTE);
      if (off.length) { filled(gl.ARRAY_BUFFER, off); given(2, 1, gl.BYTE); }
      filled(gl.ELEMENT_ARRAY_BUFFER, corners);
      const found = { array, count: 3 * F, type: wide ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT, grow: +source.dataset.half / config.half, heat: off.length > 0 };
      made.set(key, found);
      if (made.size > 24) {  // the oldest goes; it is made again when it is wanted
        const [first, old] = made.entries().next().value;
        gl.deleteVertexArray(old.array); made.delete(first);
      }
      return found;
    }

    const reach = () => 1.25 / state.zoom;  // half the picture's height, in units of half the largest shape
    function draw() {
      const dense = Math.min(window.devicePixelRatio || 1, 2), width = Math.round(canvas.clientWidth * dense), height = Math.round(canvas.clientHeight * dense);
      if (!width || !height) return;
      if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
      gl.viewport(0, 0, width, height);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      const shape = state.key && mesh(state.key);
      if (!shape) return;
      const [a, h] = [state.azimuth, state.height], [ca, sa, ch, sh] = [Math.cos(a), Math.sin(a), Math.cos(h), Math.sin(h)];
      gl.bindVertexArray(shape.array);
      gl.uniformMatrix3fv(at("turn"), false, [-sa, -sh * ca, ch * ca, ca, -sh * sa, ch * sa, 0, ch, sh]);
      gl.uniform2f(at("size"), (reach() * width) / height, reach());
      gl.uniform2fv(at("shift"), state.shift);
      gl.uniform1f(at("grow"), shape.grow);
      gl.uniform1i(at("heat"), state.heat && shape.heat ? 1 : 0);
      gl.drawElements(gl.TRIANGLES, shape.count, shape.type, 0);
    }

    function scaled() {
      const pixel = (2 * reach() * config.half) / canvas.clientHeight, wanted = pixel * 110, power = 10 ** Math.floor(Math.log10(wanted));
      const length = [5, 2, 1].map((m) => m * power).find((v) => v <= wanted) || power;
      const bar = one("#stage-scale");
      bar.style.width = length / pixel + "px";
      bar.textContent = +length.toPrecision(3) + " " + config.unit;
    }
    const again = () => { draw(); scaled(); };
    const look = (frame) => {  // rows right, up, toward the eye
      const [x, y, z] = frame[2];
      state.height = Math.asin(Math.max(-1, Math.min(1, z)));
      state.azimuth = Math.abs(z) > 0.999 ? Math.atan2(-frame[1][1] * z, -frame[1][0] * z) : Math.atan2(y, x);
    };
    const turned = (dx, dy) => { state.azimuth -= dx; state.height = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, state.height + dy)); };
    const reset = () => { look(config.views[0].frame); state.zoom = 1; state.shift = [0, 0]; again(); };

    let held = null, awake = false;
    canvas.addEventListener("pointerdown", (e) => { held = [e.clientX, e.clientY]; awake = true; canvas.setPointerCapture(e.pointerId); });
    canvas.addEventListener("pointerup", () => { held = null; });
    canvas.addEventListener("pointercancel", () => { held = null; });
    canvas.addEventListener("pointerleave", () => { awake = held !== null; });
    canvas.addEventListener("pointermove", (e) => {
      if (!held) return;
      const [dx, dy] = [e.clientX - held[0], e.clientY - held[1]];
      held = [e.clientX, e.clientY];
      const unit = (2 * reach()) / canvas.clientHeight;
      if (e.shiftKey) state.shift = [state.shift[0] + dx * unit, state.shift[1] - dy * unit];
      else turned(dx * 0.01, dy * 0.01);
      again();
    });
    canvas.addEventListener("wheel", (e) => {
      if (!awake) return;  // the page scrolls until the viewer is clicked
      e.preventDefault();
      zoom(Math.exp(-e.deltaY * 0.0012));
    }, { passive: false });
    canvas.addEventListener("dblclick", reset);
    canvas.addEventListener("keydown", (e) => {
      const turn = { ArrowLeft: [-0.12, 0], ArrowRight: [0.12, 0], ArrowUp: [0, -0.12], ArrowDown: [0, 0.12] }[e.key];
      const nearer = { "+": 1.25, "=": 1.25, "-": 0.8 }[e.key];
      if (!turn && !nearer) return;
      e.preventDefault();
      if (turn) { turned(...turn); again(); } else zoom(nearer);
    });
    const zoom = (by) => { state.zoom = Math.max(0.3, Math.min(40, state.zoom * by)); again(); };
    new ResizeObserver(again).observe(canvas);
    reset();
    return { show: (key, heat) => { state.key = key; state.heat = heat; again(); return !!(key && mesh(key)); }, look: (i) => { look(config.views[i].frame); again(); }, zoom };
  }

  function linked(gl, vertex, fragment) {
    const program = gl.createProgram();
    [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]].forEach(([kind, source]) => {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    });
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return program;
  }

  // The page: which design is open, and how it is shown.
  const canvas = one("#viewer"), say = one("#stage-say");
  const stage = canvas && viewer(canvas);
  let open = config.first, mode = "plain";

  function shown() {
    if (!canvas) return;
    const known = config.designs[open] || {};
    const key = mode === "reference" ? known.reference : open;
    const done = stage ? stage.show(key, mode === "heat") : false;
    one("#stage-title").textContent = (mode === "reference" ? "exemplar " + known.beside : known.title) + (mode === "heat" && known.beside ? ", distance to " + known.beside : "");
    say.hidden = done;
    say.textContent = stage ? "no shape to show" : "This browser shows no WebGL 2; the pictures are all there is.";
  }

  function select(key, quiet) {
    const detail = document.getElementById("t-" + key);
    if (!detail || !config.designs[key]) return;
    open = key;
    one("#detail").replaceChildren(detail.content.cloneNode(true));
    all("[data-key]").forEach((item) => item.classList.toggle("on", item.dataset.key === key));
    all(".strand.on").forEach((strand) => strand.parentElement.append(strand));  // above the others
    shown();
    if (!quiet) one("#shapes").scrollIntoView({ behavior: "smooth", block: "start" });
  }

  const pressed = (button) => all("button", button.parentElement).forEach((b) => b.classList.toggle("on", b === button));
  all("[data-mode]").forEach((b) => b.addEventListener("click", () => { pressed(b); mode = b.dataset.mode; shown(); }));
  all("[data-view]").forEach((b) => b.addEventListener("click", () => stage && stage.look(+b.dataset.view)));
  all("[data-zoom]").forEach((b) => b.addEventListener("click", () => stage && stage.zoom(+b.dataset.zoom)));
  all("[data-filter]").forEach((b) => b.addEventListener("click", () => {
    pressed(b);
    all(".card").forEach((card) => { card.hidden = b.dataset.filter !== "all" && card.dataset.kind !== b.dataset.filter; });
  }));
  all("[data-paint]").forEach((b) => b.addEventListener("click", () => {
    pressed(b);
    all(".card img[data-heat]").forEach((img) => {
      img.dataset.plain ||= img.getAttribute("src");
      img.src = img.dataset[b.dataset.paint];
    });
  }));
  all(".card").forEach((card) => card.addEventListener("click", () => select(card.dataset.key, true)));
  all(".mark[data-key], .all tr[data-key]").forEach((mark) => mark.addEventListener("click", () => select(mark.dataset.key)));

  // Pictures where a mark is pointed at, and in the map of shapes.
  const picture = (key) => {
    const img = one(`.card[data-key="${key}"] img`);
    if (img) return img.dataset.plain || img.getAttribute("src");
    const kept = document.getElementById("t-" + key), beside = kept && kept.content.querySelector("img");
    return beside && beside.getAttribute("src");
  };
  all("image[data-from]").forEach((image) => { const src = picture(image.dataset.from); if (src) image.setAttribute("href", src); });
  const tip = one("#tip");
  all("svg > title").forEach((title) => title.remove());  // the label says it too; it would show beside the tip
  all(".strand > .way").forEach((way) => {  // thin lines are met from a little way off
    const reach = way.cloneNode();
    reach.setAttribute("class", "reach");
    way.before(reach);
  });
  const alike = (mark, near) => {  // the same design in every chart
    if (mark.dataset.key) all(`.mark[data-key="${mark.dataset.key}"]`).forEach((m) => m.classList.toggle("near", near));
  };
  all(".mark").forEach((mark) => {
    const title = mark.querySelector("title"), words = title.textContent;
    title.remove();  // the tip says it, with a picture
    mark.setAttribute("aria-label", words);
    mark.addEventListener("pointerenter", (e) => {
      alike(mark, true);
      const src = mark.dataset.key && picture(mark.dataset.key), text = document.createElement("span");
      text.textContent = words;
      tip.replaceChildren(text);
      if (src) { const img = new Image(); img.src = src; img.alt = ""; tip.prepend(img); }
      tip.hidden = false;
      tip.style.left = Math.min(e.clientX + 14, innerWidth - 240) + "px";
      tip.style.top = Math.min(e.clientY + 14, innerHeight - tip.offsetHeight - 12) + "px";
    });
    mark.addEventListener("pointerleave", () => { alike(mark, false); tip.hidden = true; });
  });
  select(open, true);
})();
