"use strict";
// R_d(x, .) at a clicked point, as exitance per irradiance, and its curve against distance.

// Logarithms at all vertices of exitance per irradiance from a point: by the factors, or, at a vertex with a column of
// the truth, the model's own column and the truth's.
class Responses {
  constructor(block, model) {
    Object.assign(this, { block, model });
    this.truthOf = new Map(Array.from(block.arrays.truth_vertices, (v, n) => [v, n]));
  }

  get known() { return this.block.head.curves.model; }

  // hit: {face, weights} -> {vertex or null, at: point, own: [logs by laser], truth: [logs by laser] or null}
  at(hit) {
    const { surface } = this.model, corners = [0, 1, 2].map((k) => surface.faces[3 * hit.face + k]);
    const place = [0, 1, 2].map((axis) =>
      corners.reduce((sum, v, k) => sum + hit.weights[k] * surface.points[3 * v + axis], 0));
    let nearest = null, distance = Infinity;
    for (const v of this.truthOf.keys()) {
      const d = Math.hypot(...minus(surface.point(v), place));
      if (d < distance) { nearest = v; distance = d; }
    }
    if (nearest !== null && distance < 0.03 * surface.size) return this.column(nearest);
    const own = Array.from({ length: this.model.lasers }, (_, laser) => this.estimate(corners, hit.weights, laser));
    return { vertex: null, place, own, truth: null };
  }

  column(vertex) {
    const n = this.truthOf.get(vertex), { truth_log: truth, column_log: own } = this.block.arrays;
    const V = this.model.surface.V, rows = truth.length / V / this.model.lasers;
    const part = (array, laser) => array.subarray((laser * rows + n) * V, (laser * rows + n + 1) * V);
    const lasers = Array.from({ length: this.model.lasers }, (_, laser) => laser);
    return {
      vertex, place: this.model.surface.point(vertex), own: lasers.map((laser) => part(own, laser)),
      truth: lasers.map((laser) => part(truth, laser)),
    };
  }

  estimate(corners, weights, laser) {
    const V = this.model.surface.V, both = this.block.head.mean_transmittance ** 2;
    const q = new Float64Array(V), sum = new Float64Array(V);
    corners.forEach((v, k) => { q[v] += weights[k]; });
    for (const term of this.model.terms) term.reflectance[laser].multiply(q, 1, sum, { near: true, far: true });
    return sum.map((x) => Math.log(Math.max(both * x, 1e-12)));
  }
}

// By ring around the point: {distance, low, middle, high} of the numbers (logarithms) there.
function rings(surface, place, logs, count = 26) {
  const distances = Array.from({ length: surface.V }, (_, v) => Math.hypot(...minus(surface.point(v), place)));
  const most = Math.max(...distances) * 1.0001, bins = Array.from({ length: count }, () => []);
  distances.forEach((d, v) => bins[Math.floor((d / most) * count)].push(logs[v]));
  return bins.map((own, n) => {
    own.sort((a, b) => a - b);
    const part = (share) => own[Math.min(own.length - 1, Math.floor(share * own.length))];
    return own.length < 3 ? null : { distance: ((n + 0.5) / count) * most, low: part(0.1), middle: part(0.5), high: part(0.9) };
  }).filter(Boolean);
}

const INKS = ["#d55e00", "#009e73", "#56b4e9"]; // told apart by all kinds of colour vision

// Medians by distance on a log scale; the truth dashed in white, with its band from the 10th to the 90th percentile.
function drawCurve(canvas, response, surface, wavelengths, laser) {
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = width * ratio; canvas.height = height * ratio;
  const pen = canvas.getContext("2d");
  pen.scale(ratio, ratio);
  pen.clearRect(0, 0, width, height);
  pen.font = "12px system-ui, sans-serif";
  const lines = (laser < 0 ? response.own.map((_, n) => n) : [laser]).flatMap((n) => [
    { ink: INKS[n], dash: [], points: rings(surface, response.place, response.own[n]), label: `${wavelengths[n]} nm` },
    ...(response.truth ? [{ ink: "#f4f4f4", dash: [5, 4], points: rings(surface, response.place, response.truth[n]), label: n === 0 || laser >= 0 ? "truth" : "" }] : []),
  ]);
  const all = lines.flatMap((line) => line.points.map((p) => p.middle / Math.LN10));
  const high = Math.ceil(Math.max(...all)), low = Math.max(Math.floor(Math.min(...all)), high - 8);
  const far = Math.max(...lines.flatMap((line) => line.points.map((p) => p.distance)));
  const left = 46, right = width - 10, top = 24, bottom = height - 34;
  const x = (d) => left + ((right - left) * d) / far, y = (log) => bottom - ((bottom - top) * (log - low)) / (high - low);
  pen.strokeStyle = "#3a404a"; pen.fillStyle = "#c2c8d0"; pen.lineWidth = 1;
  for (let d = low; d <= high; d++) {
    pen.beginPath(); pen.moveTo(left, y(d)); pen.lineTo(right, y(d)); pen.stroke();
    pen.textAlign = "right"; pen.fillText("10", left - 16, y(d) + 4);
    pen.textAlign = "left"; pen.fillText(String(d).replace("-", "−"), left - 16, y(d) - 2);
  }
  pen.textAlign = "center";
  for (let d = 0; d <= far; d += 10) pen.fillText(d, x(d), bottom + 15);
  pen.fillText("distance, mm", (left + right) / 2, height - 4);
  pen.textAlign = "left"; pen.fillText("exitance per irradiance, 1/mm²", 4, 14);
  let label = right;
  for (const line of lines) {
    pen.strokeStyle = pen.fillStyle = line.ink; pen.setLineDash(line.dash); pen.lineWidth = 2;
    pen.globalAlpha = 0.16; pen.beginPath();
    line.points.forEach((p, n) => pen[n ? "lineTo" : "moveTo"](x(p.distance), y(p.low / Math.LN10)));
    [...line.points].reverse().forEach((p) => pen.lineTo(x(p.distance), y(p.high / Math.LN10)));
    if (!line.dash.length) pen.fill();
    pen.globalAlpha = 1; pen.beginPath();
    line.points.forEach((p, n) => pen[n ? "lineTo" : "moveTo"](x(p.distance), y(p.middle / Math.LN10)));
    pen.stroke();
    if (line.label) { pen.textAlign = "right"; pen.fillText(line.label, label, top + 8); label -= pen.measureText(line.label).width + 12; }
  }
  pen.setLineDash([]);
}
