"use strict";
// From flux to radiosity: a sparse near part and a far part of low rank, and angular moments by a kernel of their own.
// As pipeline/model/{factorised,tilt}.py. Vectors side by side: x[width * vertex + n].

// One wavelength's symmetric kernel. pairs: {first, second} vertices, near: one number a pair; patch: of a vertex;
// basis[rank * v + k]: of its patch's functions; coupling[modes * (rank * patch + k) + ...]: of all patches' functions
class Kernel {
  constructor({ pairs, near, patch, basis, coupling, rank, modes }) {
    Object.assign(this, { pairs, near, patch, basis, coupling, rank, modes, V: patch.length });
  }

  // Adds the product with `width` vectors to y. parts: {near, far}: whether each counts
  multiply(x, width, y, parts) {
    const { V, rank, modes, basis, coupling, near, patch } = this, { first, second } = this.pairs;
    if (parts.near)
      for (let n = 0; n < near.length; n++) {
        const w = near[n], i = width * first[n], j = width * second[n];
        if (i === j) { for (let c = 0; c < width; c++) y[i + c] += w * x[i + c]; continue; }
        for (let c = 0; c < width; c++) { y[i + c] += w * x[j + c]; y[j + c] += w * x[i + c]; }
      }
    if (!parts.far || !modes) return;
    const entering = new Float64Array(modes * width), leaving = new Float64Array(modes * width);
    for (let v = 0; v < V; v++)
      for (let k = 0, m = width * rank * patch[v]; k < rank; k++, m += width)
        for (let c = 0; c < width; c++) entering[m + c] += basis[rank * v + k] * x[width * v + c];
    for (let m = 0; m < modes; m++) {
      let lit = false;
      for (let c = 0; c < width; c++) lit ||= entering[width * m + c] !== 0;
      if (!lit) continue;
      for (let n = 0, to = 0; n < modes; n++, to += width) {
        const w = coupling[modes * m + n];
        if (w) for (let c = 0; c < width; c++) leaving[to + c] += w * entering[width * m + c];
      }
    }
    for (let v = 0; v < V; v++)
      for (let k = 0, m = width * rank * patch[v]; k < rank; k++, m += width)
        for (let c = 0; c < width; c++) y[width * v + c] += basis[rank * v + k] * leaving[m + c];
  }

  // The kernel of directions, R_d s(r) / r, on the same functions (pipeline/model/tilt.py). law: {distance, slope}
  tilted(points, law) {
    const { pairs, near, patch, basis, rank, modes, coupling, V } = this, { first, second } = pairs;
    const logs = law.distance.map(Math.log), first2 = law.distance[0] ** 2, last2 = law.distance[logs.length - 1] ** 2;
    const steps = 1024, low = 2 * logs[0], step = (2 * logs[logs.length - 1] - low) / steps || 1; // of ln r^2
    const table = Float64Array.from({ length: steps + 2 }, (_, n) => interpolate((low + n * step) / 2, logs, law.slope));
    const times = (i, j) => {
      const x = points[3 * i] - points[3 * j], y = points[3 * i + 1] - points[3 * j + 1], z = points[3 * i + 2] - points[3 * j + 2];
      const r2 = x * x + y * y + z * z;
      if (!(r2 > 0)) return 0;
      const at = r2 <= first2 ? 0 : r2 >= last2 ? steps : (Math.log(r2) - low) / step, n = Math.floor(at);
      return (table[n] + (at - n) * (table[n + 1] - table[n])) / Math.sqrt(r2);
    };
    const close = Float32Array.from(near, (value, n) => value * times(first[n], second[n]));
    const members = Array.from({ length: rank ? modes / rank : 0 }, () => []), out = new Float32Array(modes * modes);
    for (let v = 0; v < V && rank; v++) members[patch[v]].push(v);
    for (let a = 0; a < members.length; a++)
      for (let b = a; b < members.length; b++) {
        const corner = modes * rank * a + rank * b;
        if (!coupling[corner] && !coupling[corner + 1]) continue; // near patches
        const sum = new Float64Array(rank * rank), right = new Float64Array(rank), to = new Float64Array(rank);
        for (const i of members[a]) {
          right.fill(0);
          to.fill(0);
          for (let k = 0; k < rank; k++) for (let l = 0; l < rank; l++) right[l] += basis[rank * i + k] * coupling[corner + modes * k + l];
          for (const j of members[b]) {
            let entry = 0;
            for (let l = 0; l < rank; l++) entry += right[l] * basis[rank * j + l];
            entry *= times(i, j);
            for (let l = 0; l < rank; l++) to[l] += entry * basis[rank * j + l];
          }
          for (let k = 0; k < rank; k++) for (let l = 0; l < rank; l++) sum[rank * k + l] += basis[rank * i + k] * to[l];
        }
        for (let k = 0; k < rank; k++)
          for (let l = 0; l < rank; l++)
            out[corner + modes * k + l] = out[modes * (rank * b + l) + rank * a + k] = sum[rank * k + l];
      }
    return new Kernel({ pairs, near: close, patch, basis, coupling: out, rank, modes });
  }
}

const EVERYTHING = { near: true, far: true, entry: true, exit: true };

class Model {
  // surface: a Surface; terms: [{reflectance: [Kernel by laser], tilt: [Kernel by laser] or null}]
  constructor(surface, terms, lasers) {
    Object.assign(this, { surface, terms, lasers });
    const V = surface.V, mean = [0, 0, 0];
    for (let v = 0; v < V; v++) surface.point(v).forEach((x, k) => { mean[k] += x / V; });
    this.points = Float64Array.from(surface.points, (x, n) => x - mean[n % 3]); // less is lost where positions cancel
  }

  // One laser's radiosity and its first moments, 4 numbers a vertex in W/mm^2. flux: 4 a vertex in W; parts: what counts
  radiosity(flux, laser, parts = EVERYTHING) {
    const V = this.surface.V, x = this.points, out = new Float64Array(4 * V), own = new Float64Array(V);
    for (let v = 0; v < V; v++) own[v] = flux[4 * v];
    for (const term of this.terms) {
      const sum = new Float64Array(V);
      term.reflectance[laser].multiply(own, 1, sum, parts);
      for (let v = 0; v < V; v++) out[4 * v] += sum[v];
      if (!term.tilt || !(parts.entry || parts.exit)) continue;
      const placed = new Float64Array(8 * V), product = new Float64Array(8 * V);
      for (let v = 0; v < V; v++) {
        const q = flux[4 * v], a = 8 * v, p = 3 * v;
        if (parts.entry)
          for (let k = 0; k < 3; k++) {
            placed[a + k] = flux[4 * v + 1 + k];
            placed[a + 3] += flux[4 * v + 1 + k] * x[p + k];
          }
        if (!parts.exit) continue;
        placed[a + 4] = q;
        for (let k = 0; k < 3; k++) placed[a + 5 + k] = q * x[p + k];
      }
      term.tilt[laser].multiply(placed, 8, product, parts);
      for (let v = 0; v < V; v++) {
        const a = 8 * v, p = 3 * v;
        out[4 * v] -= product[a + 3];
        for (let k = 0; k < 3; k++) {
          out[4 * v] += product[a + k] * x[p + k];
          out[4 * v + 1 + k] += product[a + 4] * x[p + k] - product[a + 5 + k];
        }
      }
    }
    return out;
  }
}

// The surface and the model of a parsed block.
function modelOf({ head, arrays }) {
  const surface = new Surface(arrays.points, arrays.faces, arrays.normals), V = surface.V, L = head.lasers;
  const part = (array, laser) => array.subarray((laser * array.length) / L, ((laser + 1) * array.length) / L);
  const terms = head.terms.map((term, n) => {
    const name = (what) => arrays[`term${n}.${what}`];
    const counts = name("pair_counts"), first = new Uint32Array(name("pair_second").length);
    for (let v = 0, at = 0; v < V; v++) for (let k = 0; k < counts[v]; k++) first[at++] = v;
    const pairs = { first, second: name("pair_second") };
    const reflectance = Array.from({ length: L }, (_, laser) => {
      const scale = part(name("coupling_scale"), laser), upper = part(name("coupling"), laser), modes = scale.length;
      const coupling = new Float32Array(modes * modes);
      for (let m = 0, at = 0; m < modes; m++)
        for (let n = m; n < modes; n++)
          coupling[modes * m + n] = coupling[modes * n + m] = upper[at++] * Math.sqrt(scale[m] * scale[n]);
      return new Kernel({ pairs, near: part(name("near"), laser), patch: name("patch"), basis: part(name("basis"), laser),
        coupling, rank: term.rank, modes });
    });
    const law = (laser) => ({ distance: term.tilt.distance, slope: term.tilt.slope[laser] });
    return { reflectance, tilt: term.tilt && reflectance.map((kernel, laser) => kernel.tilted(surface.points, law(laser))) };
  });
  return new Model(surface, terms, L);
}

// By laser, 4 numbers a vertex: the flux of a light of this block. gains: factors by laser
function fluxByLaser(block, surface, light, gains, accuracy = FINE, shadows = true) {
  const colour = light.colour || [];
  if (light.stored !== undefined && light.stored !== null) {
    const stored = block.arrays[`flux${light.stored}`], size = 4 * surface.V;
    return gains.map((gain, laser) => Float64Array.from(stored.subarray(laser * size, (laser + 1) * size), (x) => gain * x));
  }
  const one = fluxThrough(surface, light.boundary || block.head.boundary, light, accuracy, shadows);
  return gains.map((gain, laser) => Float64Array.from(one, (x) => gain * colour[laser] * x));
}
