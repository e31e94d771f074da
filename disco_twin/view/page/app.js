"use strict";
// The page: state, what follows from it, and the hands that change it.

const MODES = { natural: 0, false: 1 };
const HELP = "Drag turns, wheel or pinch zooms, Shift and drag moves the light. Keys: arrows turn or move the light, + and − "
  + "zoom, [ and ] expose, 1 to 9 choose the light, O L P what dragging does, F false colour, C compare.";

class App {
  constructor(block, model, painter) {
    Object.assign(this, { block, model, painter, head: block.head, surface: model.surface });
    this.responses = new Responses(block, model);
    this.canvas = painter.canvas;
    this.lights = this.head.lights.map((light) => structuredClone(light));
    const first = this.head.views[0], pose = first.pose;
    const eye = minus(eyeOf(pose), this.surface.centre), distance = Math.hypot(...eye);
    this.orbit = { azimuth: Math.atan2(eye[1], eye[0]), height: Math.asin(eye[2] / distance), distance, field: first.height / first.focal[1] };
    this.home = { ...this.orbit };
    this.references = new Map();
    this.point = null;
    this.dragged = false;
    this.state = {
      light: 0, tool: "turn", layout: "free", view: 0, look: "natural", exposure: 0, decades: 3, laser: -1, size: 0,
      strength: 0, near: true, far: true, entry: true, exit: true, shadows: true, rough: true,
    };
    this.head.wavelengths_nm.forEach((_, n) => { this.state[`gain${n}`] = 1; });
    this.whites = new Map();
    this.buildPanel();
    this.listen();
    this.changed("light");
    this.panel.show();
  }

  get light() { return this.lights[this.state.light]; }
  get shipped() { return JSON.stringify(this.light) === JSON.stringify(this.head.lights[this.state.light]); }
  get gains() { return this.head.wavelengths_nm.map((_, n) => this.state[`gain${n}`] * 10 ** this.state.strength); }

  buildPanel() {
    const panel = (this.panel = new Panel(document.getElementById("panel"), this.state, (name) => this.changed(name)));
    const nm = this.head.wavelengths_nm, factor = (x) => `× ${x.toFixed(2)}`;
    const decades = (x) => `${x > 0 ? "+" : ""}${x.toFixed(2)} dec`;
    panel.group("Light", panel.buttons("light", this.lights.map((light, n) => [n, light.name, String(n + 1)])),
      panel.slider("size", "Its size", -1, 1, 0.05, () => this.detail()),
      panel.slider("strength", "Strength", -2, 2, 0.05, decades),
      ...nm.map((w, n) => panel.slider(`gain${n}`, `${w} nm`, 0, 2, 0.02, factor)),
      element("div", { class: "row" }, element("button", { type: "button", onclick: () => this.reset() }, "As shipped")));
    panel.group("Dragging", panel.buttons("tool", [["turn", "turns", "O"], ["light", "moves the light", "L"], ["point", "picks a point", "P"]]));
    panel.group("Look", panel.buttons("look", [["natural", "natural", "F"], ["false", "false colour", "F"]]),
      panel.slider("exposure", "Exposure", -3, 3, 0.05, decades),
      panel.slider("decades", "Decades", 1, 6, 1, (x) => x),
      panel.buttons("laser", [[-1, nm.length > 1 ? "mean" : `${nm[0]} nm`, ""], ...(nm.length > 1 ? nm.map((w, n) => [n, `${w} nm`, ""]) : [])]));
    panel.group("Compare", panel.buttons("layout", [["free", "free view", "C"], ["compare", "beside reference", "C"], ["response", "R_d at a point", "P"]]),
      panel.buttons("view", this.head.views.map((view, n) => [n, view.name, ""])), element("p", { class: "note", id: "score" }));
    panel.group("Terms of the model", panel.tick("near", "near part"), panel.tick("far", "far part"),
      panel.tick("entry", "direction of entry"), panel.tick("exit", "direction of exit"),
      panel.tick("shadows", "shadows"), panel.tick("rough", "measured boundary"));
    panel.group("R_d from a point", element("canvas", { id: "curve" }), element("p", { class: "note", id: "response" },
      "Pick a point (key P) to see where its light leaves. Near a column of the truth, that is shown beside."));
    const terms = this.head.terms.map((term) => `${term.modes} modes`).join(", ");
    document.getElementById("about").textContent = `${this.head.scene}, seed ${this.head.seed}, method ${this.head.method}; `
      + `${this.head.vertices} vertices, ${terms}, ${this.head.kept.near} near entries a row at most. Radiance in W/(mm² sr). `
      + `${this.head.provenance.join("; ")}.`;
    panel.group("Hands and keys", element("p", { class: "note" }, HELP));
  }

  // ---- from state to picture

  changed(name) {
    if (name === "light") { this.state.size = 0; }
    if (name === "size") this.resize();
    if (name === "view" && this.state.layout !== "compare") this.lookFrom(this.head.views[this.state.view]);
    if (name === "tool" && this.state.tool === "point") this.state.layout = "response";
    if (["light", "size", "moved", "shadows", "rough"].includes(name)) this.flux = null;
    if (["light", "size", "moved", "shadows", "rough", "strength", "near", "far", "entry", "exit"].includes(name)
      || name.startsWith("gain")) this.radiosity = null;
    if (name === "light") this.whites.delete(this.state.light);
    this.draw();
  }

  draw() {
    if (this.pending) return;
    this.pending = requestAnimationFrame(() => {
      this.pending = 0;
      const start = performance.now();
      this.compute();
      this.paint();
      if (this.dragged) return;
      const took = performance.now() - start;
      document.getElementById("status").textContent = this.painter.gl.isContextLost() ? "The graphics card was lost." :
        `${this.light.name}${this.shipped ? "" : ", moved"}: ${took.toFixed(0)} ms`;
    });
  }

  // Flux and radiosity of the light as it is, as far as they are not known.
  compute() {
    const boundary = this.state.rough ? this.head.boundary : { eta: this.head.boundary.eta, cosines: [1], ratio: [1] };
    if (!this.flux) {
      const light = { ...this.light, boundary };
      this.flux = fluxByLaser(this.block, this.surface, light, this.gains.map(() => 1), this.dragged ? DRAGGED : FINE, this.state.shadows);
      this.painter.setBoundary(boundary);
    }
    if (!this.radiosity) {
      const gains = this.gains;
      this.radiosity = this.flux.map((flux, laser) => {
        const own = this.model.radiosity(flux, laser, this.state);
        return own.map((x) => gains[laser] * x);
      });
      this.shown = null;
    }
    if (!this.whites.has(this.state.light)) {
      const all = this.radiosity.flatMap((own) => Array.from({ length: this.surface.V }, (_, v) => own[4 * v])).sort((a, b) => a - b);
      this.whites.set(this.state.light, Math.max(all[Math.floor(0.998 * all.length)] / Math.PI, 1e-30));
    }
  }

  paint() {
    const { canvas, painter, state } = this, ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio)), height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    const gl = painter.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.clearColor(...GROUND, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const wanted = state.layout === "response" && this.point ? this.point : this.radiosity;
    if (this.shown !== wanted) {
      painter.setValues(wanted === this.point ? this.point.own.map((logs) => valuesOf(logs)) : wanted);
      this.shown = wanted;
    }
    const look = { mode: MODES[state.look], white: this.whites.get(state.light) * 10 ** -state.exposure, decades: state.decades, laser: state.laser, span: 0.2 };
    const labels = document.getElementById("labels");
    labels.replaceChildren();
    if (state.layout === "compare") this.paintBeside(width, height, ratio, look, labels);
    else {
      const response = wanted === this.point, samples = this.dragged || width * height > 1.5e6 ? 1 : 2;
      if (response) Object.assign(look, { mode: 1, white: this.point.peak * 10 ** -state.exposure, decades: Math.max(state.decades, 5) });
      painter.present(painter.renderRadiance(this.camera(width, height), samples, response), [0, 0, width, height], look);
      if (state.tool === "point") this.markTruth(labels);
      drawScale(document.getElementById("scale"), this.orbit.distance / this.camera(canvas.clientWidth, canvas.clientHeight).focal[0], canvas.clientWidth);
      drawLegend(document.getElementById("legend"), look, response ? "exitance per irradiance, 1/mm²" : "radiance, W/(mm² sr)");
    }
    this.writeScore();
  }

  // Relit, reference and difference at the view's own pixels, as far as they show the object.
  paintBeside(width, whole, ratio, look, labels) {
    const foot = Math.round(58 * ratio), height = whole - foot; // the legend's place
    const { painter, state } = this, view = this.head.views[state.view], crop = this.frameOf(view);
    const room = (columns) => Math.min(width / columns / crop.width, height / (4 - columns) / crop.height);
    const columns = room(3) > room(1) ? 3 : 1, zoom = Math.max(1, room(columns)), cell = [width / columns, height / (4 - columns)];
    const relit = painter.renderRadiance(view, 4), reference = this.reference(state.light, state.view);
    const panels = [["relit", relit, relit, look.mode], ["reference", reference, relit, look.mode], ["difference", relit, reference, 2]];
    panels.forEach(([title, image, other, mode], n) => {
      const size = [crop.width * zoom, crop.height * zoom].map((x, k) => Math.floor(Math.min(x, cell[k])));
      const corner = columns === 3 ? [n * cell[0], foot] : [0, foot + (2 - n) * cell[1]];
      const at = corner.map((x, k) => Math.floor(x + (cell[k] - size[k]) / 2));
      painter.present(image, [...at, ...size], { ...look, mode }, { zoom, skipped: crop.skipped, other });
      const label = element("span", {}, title);
      label.style.left = `${at[0] / ratio}px`;
      label.style.top = `${(whole - at[1] - size[1]) / ratio}px`;
      labels.append(label);
    });
    drawScale(document.getElementById("scale"), (view.mm_per_pixel / zoom) * ratio, (crop.width * zoom) / ratio);
    drawLegend(document.getElementById("legend"), { ...look, mode: 2 }, "");
  }

  // The part of a view that can show the object: {skipped: pixels from the lower left, width, height}
  frameOf(view) {
    const all = Array.from({ length: this.surface.V }, (_, v) => project(view, this.surface.point(v)));
    const [low, high] = [Math.min, Math.max].map((most, side) =>
      [0, 1].map((k) => Math.floor(all.reduce((x, p) => most(x, p[k]), side ? -Infinity : Infinity)) + (side ? 4 : -3)));
    const left = Math.max(0, low[0]), top = Math.max(0, low[1]), right = Math.min(view.width, high[0]), below = Math.min(view.height, high[1]);
    return { skipped: [left, view.height - below], width: right - left, height: below - top };
  }

  // Dots on the vertices with a column of the truth, as far as they are seen.
  markTruth(labels) {
    const box = this.canvas.getBoundingClientRect(), camera = this.camera(box.width, box.height), eye = eyeOf(camera.pose);
    for (const v of this.responses.truthOf.keys()) {
      const point = this.surface.point(v), way = minus(point, eye), away = Math.hypot(...way);
      const hit = this.surface.trace(...eye, ...unit(way), false);
      if (hit && hit.distance < away - 1e-3 * this.surface.size) continue;
      const [x, y] = project(camera, point), dot = element("i");
      Object.assign(dot.style, { left: `${x}px`, top: `${y}px` });
      labels.append(dot);
    }
  }

  // The reference of a shipped light in a held-out view, as a texture.
  reference(light, view) {
    const name = `reference${light}.${view}`;
    if (!this.references.has(name)) {
      const { width, height } = this.head.views[view], from = this.block.arrays[name], L = this.head.lasers, size = width * height;
      const data = new Float32Array(4 * size);
      for (let n = 0; n < size; n++) {
        for (let laser = 0; laser < L; laser++) data[4 * n + laser] = from[laser * size + n];
        for (let laser = 0; laser < L; laser++) if (data[4 * n + laser] > 0) data[4 * n + 3] = 1;
      }
      this.references.set(name, { texture: this.painter.floatTexture(width, height, data), samples: 1, rows: height });
    }
    return this.references.get(name);
  }

  writeScore() {
    const { state } = this, view = this.head.views[state.view].name, error = this.head.errors[`${this.light.name}@${view}`];
    const nrmse = error === null || error === undefined ? "no score" : `nrmse ${error.toFixed(3)}`;
    document.getElementById("score").textContent = this.shipped
      ? `${this.light.name} from ${view}: ${nrmse} of the pipeline's relighting; factors change radiosity by ${(100 * this.head.lights[state.light].off).toFixed(1)} % rms at most.`
      : "The reference is of the light as shipped, not of the moved one.";
  }

  // ---- moving things

  camera(width, height) {
    const { azimuth, height: rise, distance, field } = this.orbit, c = this.surface.centre;
    const eye = plus(c, [Math.cos(azimuth) * Math.cos(rise), Math.sin(azimuth) * Math.cos(rise), Math.sin(rise)], distance);
    const rows = lookAt(eye, c, [0, 0, 1]), pose = rows.map((row) => [...row, -dot(row, eye)]), focal = Math.min(height, width * 0.8) / field;
    return { width, height, focal: [focal, focal], centre: [width / 2, height / 2], pose };
  }

  lookFrom(view) {
    const eye = minus(eyeOf(view.pose), this.surface.centre), distance = Math.hypot(...eye);
    Object.assign(this.orbit, { azimuth: Math.atan2(eye[1], eye[0]), height: Math.asin(eye[2] / distance), distance, field: view.height / view.focal[1] });
  }

  turn(dx, dy) {
    this.orbit.azimuth -= dx;
    this.orbit.height = Math.min(1.55, Math.max(-1.55, this.orbit.height + dy));
    if (this.state.layout === "compare") this.panel.set("layout", "free");
    this.draw();
  }

  zoom(factor) { this.orbit.field = Math.min(0.6, Math.max(0.01, this.orbit.field * factor)); this.draw(); }

  // {face, weights, distance, place} under a point of the page, null beside the object
  pick(clientX, clientY) {
    const box = this.canvas.getBoundingClientRect(), camera = this.camera(box.width, box.height), p = camera.pose;
    const local = [(clientX - box.left - camera.centre[0]) / camera.focal[0], (clientY - box.top - camera.centre[1]) / camera.focal[1], 1];
    const way = unit([0, 1, 2].map((k) => p[0][k] * local[0] + p[1][k] * local[1] + p[2][k])), eye = eyeOf(p);
    const hit = this.surface.trace(...eye, ...way, false);
    return hit && { ...hit, place: plus(eye, way, hit.distance) };
  }

  // The light falls where the finger is: a spot and a projector head-on, an edge through it, parallel light from its side.
  aim(hit) {
    const { light } = this, n = this.surface.smoothNormal(hit.face, hit.weights);
    if (light.kind === "beam") Object.assign(light, { through_mm: hit.place, direction: n.map((x) => -x) });
    else if (light.kind === "projector") {
      const away = Math.hypot(...minus(light.position_mm, light.aim_mm));
      Object.assign(light, { aim_mm: hit.place, position_mm: plus(hit.place, n, away) });
    } else if (light.kind === "directional" && light.edge_side) light.edge_offset_mm = dot(hit.place, edgeNormal(light));
    else if (light.kind === "directional") light.direction = n.map((x) => -x);
    else return this.say(`${light.name} comes from everywhere and cannot be aimed; choose another light`);
    this.changed("moved");
  }

  nudge(dx, dy) {
    const box = this.canvas.getBoundingClientRect(), middle = [box.left + box.width / 2, box.top + box.height / 2];
    this.cursor = this.cursor || middle;
    this.cursor = [this.cursor[0] + dx, this.cursor[1] + dy];
    const hit = this.pick(...this.cursor);
    if (hit) this.aim(hit);
    else this.cursor = null;
  }

  detail() {
    const { light } = this;
    if (light.kind === "beam") return `${light.diameter_mm.toFixed(1)} mm`;
    return light.kind === "projector" ? `${light.period_mm.toFixed(1)} mm` : "–";
  }

  resize() {
    const from = this.head.lights[this.state.light], factor = 4 ** this.state.size;
    if (from.kind === "beam") this.light.diameter_mm = from.diameter_mm * factor;
    if (from.kind === "projector") this.light.period_mm = from.period_mm * factor;
  }

  reset() {
    this.lights[this.state.light] = structuredClone(this.head.lights[this.state.light]);
    Object.assign(this.orbit, this.home);
    Object.assign(this.state, { size: 0, strength: 0, exposure: 0 });
    this.head.wavelengths_nm.forEach((_, n) => { this.state[`gain${n}`] = 1; });
    this.panel.set("light", this.state.light);
  }

  respond(hit) {
    if (!this.responses.known) return this.say("this model states no R_d between different points");
    const point = this.responses.at(hit);
    point.peak = Math.exp(Math.max(...point.own.flatMap((logs) => Array.from(logs))));
    this.point = point;
    this.state.layout = "response";
    drawCurve(document.getElementById("curve"), point, this.surface, this.head.wavelengths_nm, this.state.laser);
    document.getElementById("response").textContent = point.truth
      ? `Vertex ${point.vertex}: medians by distance of the model and, dashed, of the truth; band: 10 to 90 % of the model.`
      : "Medians by distance; band: 10 to 90 %. Pick one of the dots to see the truth beside.";
    document.getElementById("response").scrollIntoView({ block: "nearest" });
    this.panel.show();
    this.draw();
  }

  say(text) { document.getElementById("status").textContent = text; }

  listen() {
    const { canvas } = this, fingers = new Map();
    const settle = () => { if (this.dragged) { this.dragged = false; this.flux = this.radiosity = null; this.draw(); } };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      canvas.focus({ preventScroll: true });
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      const tool = event.shiftKey ? "light" : this.state.tool, hit = tool === "turn" || this.state.layout === "compare" ? null : this.pick(event.clientX, event.clientY);
      if (hit && tool === "point") this.respond(hit);
      if (hit && tool === "light") { this.dragged = true; this.aim(hit); }
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const now = [event.clientX, event.clientY], [dx, dy] = [now[0] - before[0], now[1] - before[1]];
      if (fingers.size === 2) {
        const [other] = [...fingers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
        this.zoom(Math.hypot(before[0] - other[0], before[1] - other[1]) / Math.max(1, Math.hypot(now[0] - other[0], now[1] - other[1])));
      } else if (this.dragged) { const hit = this.pick(...now); if (hit) this.aim(hit); }
      else if (!(this.state.tool !== "turn" && this.pick(...now))) this.turn(dx * 0.008, dy * 0.008);
      fingers.set(event.pointerId, now);
    });
    for (const name of ["pointerup", "pointercancel"])
      canvas.addEventListener(name, (event) => { fingers.delete(event.pointerId); settle(); });
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.zoom(Math.exp(event.deltaY * 0.001)); }, { passive: false });
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      apologise("The graphics card was lost. Load the page again to go on; the picture is of the pipeline's own relighting.");
    });
    window.addEventListener("resize", () => this.draw());
    document.addEventListener("keydown", (event) => this.key(event));
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT)$/.test(event.target.tagName)) return;
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }, arrow = arrows[event.key];
    const other = (name, one, two) => this.panel.set(name, this.state[name] === one ? two : one);
    const acts = {
      "+": () => this.zoom(0.9), "=": () => this.zoom(0.9), "-": () => this.zoom(1.1),
      "[": () => this.panel.set("exposure", this.state.exposure - 0.25), "]": () => this.panel.set("exposure", this.state.exposure + 0.25),
      o: () => this.panel.set("tool", "turn"), l: () => this.panel.set("tool", "light"), p: () => this.panel.set("tool", "point"),
      f: () => other("look", "false", "natural"), c: () => other("layout", "compare", "free"),
    };
    const act = acts[event.key.toLowerCase()];
    if (arrow && this.state.tool === "light") this.nudge(8 * arrow[0], 8 * arrow[1]);
    else if (arrow) this.turn(arrow[0] * 0.1, arrow[1] * 0.1);
    else if (/^[1-9]$/.test(event.key) && this.lights[event.key - 1]) this.panel.set("light", event.key - 1);
    else if (act) act();
    else return;
    event.preventDefault();
  }
}

// Logarithms as the values that the mesh is drawn with.
function valuesOf(logs) {
  const out = new Float64Array(4 * logs.length);
  logs.forEach((x, v) => { out[4 * v] = Math.exp(x); });
  return out;
}

// A sentence and the still picture in place of the canvas.
function apologise(text) {
  for (const id of ["canvas", "labels", "scale", "legend"]) document.getElementById(id).hidden = true;
  const box = document.getElementById("sorry");
  box.hidden = false;
  box.firstElementChild.textContent = text;
  document.getElementById("status").textContent = "";
}

// What tests read: numbers, not pictures. `ready` ends with the text of what went wrong, or "".
const twin = (window.discoTwin = {
  ready: (async () => {
    try {
      if (typeof DecompressionStream === "undefined") throw new Error("a browser from before 2023");
      const block = await unpackBlock(document.getElementById("block").textContent), model = modelOf(block);
      twin.app = new App(block, model, new Painter(document.getElementById("canvas"), model.surface, block.head));
      return "";
    } catch (error) {
      apologise(`This browser cannot relight the object (${error.message}); it needs WebGL2. `
        + "The picture is of the pipeline's own relighting. A current Firefox, Chrome, Edge or Safari shows the page.");
      return error.message;
    }
  })(),
  // Radiosity and moments by laser, 4 numbers a vertex, of a shipped light.
  radiosity(light) {
    const { app } = twin, flux = fluxByLaser(app.block, app.surface, app.head.lights[light], app.gains.map(() => 1));
    return flux.map((own, laser) => app.model.radiosity(own, laser));
  },
  // Linear radiance of a shipped light in a held-out view, as it is drawn.
  image(light, view) {
    const { app } = twin;
    app.painter.setBoundary(app.head.boundary);
    app.painter.setValues(twin.radiosity(light));
    app.shown = null;
    return app.painter.readRadiance(app.head.views[view]);
  },
});
