"use strict";
// From a light to the flux that it sends through the vertices: shadows, Fresnel, and the part of the refracted
// direction along the surface. As pipeline/relight/{incident_light,irradiance}.py, for lights of one direction a point.

// boundary: {eta, cosines, ratio} -> F_t of the cosine outside; 0 below the horizon
function transmittance(boundary, cosine) {
  if (!(cosine > 0)) return 0;
  const { eta, cosines, ratio } = boundary, c = Math.min(cosine, 1), inside = Math.sqrt(eta * eta - 1 + c * c) / eta;
  const product = 4 * eta * c * inside;
  const smooth = 0.5 * (product / (c + eta * inside) ** 2 + product / (inside + eta * c) ** 2);
  return smooth * interpolate(c, cosines, ratio);
}

// Linear between the ascending xs, constant beyond.
function interpolate(x, xs, ys) {
  const last = xs.length - 1;
  if (x <= xs[0]) return ys[0];
  if (x >= xs[last]) return ys[last];
  let n = 1;
  while (xs[n] < x) n++;
  return ys[n - 1] + ((ys[n] - ys[n - 1]) * (x - xs[n - 1])) / (xs[n] - xs[n - 1]);
}

// (3 rows: right, down, forward) of a device at `position` that looks at `aim`, as pipeline.geometry.camera.look_at.
function lookAt(position, aim, up) {
  const forward = unit(minus(aim, position));
  let right = cross(forward, up);
  if (Math.hypot(...right) <= 1e-6 * Math.hypot(...up))
    right = cross(forward, Math.abs(forward[1]) < 0.9 ? [0, 1, 0] : [1, 0, 0]);
  right = unit(right);
  return [right, cross(forward, right), forward];
}

// What arrives at a point: a function (x, y, z, out) that leaves in out the unit direction towards the light and, as
// the fourth number, the irradiance across it in W/mm^2.
function arriving(light) {
  if (light.kind === "directional") {
    const along = unit(light.direction), side = light.edge_side && edgeNormal(light);
    return (x, y, z, out) => {
      out[0] = -along[0]; out[1] = -along[1]; out[2] = -along[2];
      out[3] = side && side[0] * x + side[1] * y + side[2] * z < light.edge_offset_mm ? 0 : light.irradiance;
    };
  }
  if (light.kind === "beam") {
    const d = unit(light.direction), a = light.through_mm, radius = light.diameter_mm / 2;
    const across = light.power_w / (Math.PI * radius * radius);
    return (x, y, z, out) => {
      const r = cross([x - a[0], y - a[1], z - a[2]], d);
      out[0] = -d[0]; out[1] = -d[1]; out[2] = -d[2];
      out[3] = r[0] * r[0] + r[1] * r[1] + r[2] * r[2] <= radius * radius ? across : 0;
    };
  }
  if (light.kind !== "projector") throw new Error("no single direction: " + light.kind);
  const at = light.position_mm, [right, down, forward] = lookAt(at, light.aim_mm, light.up);
  const distance = Math.hypot(...minus(light.aim_mm, at)), turn = (2 * Math.PI) / light.period_mm;
  return (x, y, z, out) => {
    const p = [x - at[0], y - at[1], z - at[2]], range = Math.hypot(p[0], p[1], p[2]), depth = dot(p, forward);
    out[0] = -p[0] / range; out[1] = -p[1] / range; out[2] = -p[2] / range; out[3] = 0;
    if (!(depth > 0)) return;
    const a = (dot(p, right) / depth) * distance, b = (dot(p, down) / depth) * distance;
    if (Math.abs(a) > light.half_width_mm || Math.abs(b) > light.half_width_mm) return;
    const wave = Math.sin(turn * a) * Math.sin(turn * b);
    out[3] = (light.intensity * (1 + light.contrast * wave)) / (1 + light.contrast) * (depth / range) ** 3 / range ** 2;
  };
}

function edgeNormal(light) {
  const along = unit(light.direction);
  return unit(plus(light.edge_side, along, -dot(light.edge_side, along)));
}

// Size in mm of the light's own finest structure in a ball, Infinity where it has none.
function finest(light, centre, radius) {
  if (light.kind === "projector") return Math.min(light.period_mm / 2, light.half_width_mm);
  if (light.kind !== "beam") return Infinity;
  const away = Math.hypot(...cross(minus(centre, light.through_mm), unit(light.direction)));
  return away <= light.diameter_mm / 2 + radius ? light.diameter_mm : Infinity;
}

const RULE = [4, 1, 1, 1, 4, 1, 1, 1, 4].map((x) => x / 6); // three points, exact to the second degree

// How finely to integrate: cells no longer than size / coarse; split until what splitting changes, over all cells that
// are left, is below tolerance of the flux. detail: cells in the light's finest structure; plain: cells whose three
// points differ by less than this share are not split
const FINE = { coarse: 40, detail: 4, tolerance: 3e-4, splits: 9, plain: 0 };
const DRAGGED = { coarse: 12, detail: 1.5, tolerance: 1e-2, splits: 5, plain: 0.2 };

// (4 V) numbers, 4 by vertex: W transmitted, and W times the direction along the surface, by component, of a light
// with colour 1. shadows: whether the mesh shades itself
function fluxThrough(surface, boundary, light, accuracy = FINE, shadows = true) {
  const { faces, points, normals, areas, V } = surface, start = OFFSET * surface.size, { eta } = boundary;
  const moments = new Float64Array(4 * V), at = arriving(light), seen = new Float64Array(4), table = fresnelTable(boundary);

  // A cell of a face: its corners in barycentric coordinates (9 numbers), its moments (4 by corner of the face) and
  // whether its three points differ.
  function cellOf(face, c) {
    const out = new Float64Array(12), nx = normals[3 * face], ny = normals[3 * face + 1], nz = normals[3 * face + 2];
    const i = 3 * faces[3 * face], j = 3 * faces[3 * face + 1], k = 3 * faces[3 * face + 2];
    const share = Math.abs(c[0] * (c[4] * c[8] - c[5] * c[7]) - c[1] * (c[3] * c[8] - c[5] * c[6])
      + c[2] * (c[3] * c[7] - c[4] * c[6])) * areas[face] / 3;
    let least = Infinity, most = 0;
    for (let n = 0; n < 9; n += 3) {
      const a = RULE[n], b = RULE[n + 1], d = RULE[n + 2];
      const u = a * c[0] + b * c[3] + d * c[6], v = a * c[1] + b * c[4] + d * c[7], w = a * c[2] + b * c[5] + d * c[8];
      const x = u * points[i] + v * points[j] + w * points[k], y = u * points[i + 1] + v * points[j + 1] + w * points[k + 1];
      const z = u * points[i + 2] + v * points[j + 2] + w * points[k + 2];
      at(x, y, z, seen);
      const cosine = seen[0] * nx + seen[1] * ny + seen[2] * nz;
      let here = 0;
      if (cosine > 0 && seen[3] > 0) {
        const [dx, dy, dz, across] = seen;
        const dark = shadows && surface.trace(x + start * nx, y + start * ny, z + start * nz, dx, dy, dz, true);
        if (!dark) {
          here = across * lookUp(table, cosine) * cosine * share;
          const tx = (cosine * nx - dx) / eta, ty = (cosine * ny - dy) / eta, tz = (cosine * nz - dz) / eta;
          for (let m = 0; m < 3; m++) {
            const part = here * (m === 0 ? u : m === 1 ? v : w);
            out[4 * m] += part; out[4 * m + 1] += part * tx; out[4 * m + 2] += part * ty; out[4 * m + 3] += part * tz;
          }
        }
      }
      least = Math.min(least, here); most = Math.max(most, here);
    }
    return { face, corners: c, moments: out, plain: most - least <= accuracy.plain * most };
  }

  const keep = (face, part) => {
    for (let k = 0; k < 3; k++)
      for (let m = 0; m < 4; m++) moments[4 * faces[3 * face + k] + m] += part[4 * k + m];
    return part[0] + part[4] + part[8];
  };

  let cells = firstCells(surface, light, accuracy, cellOf), kept = 0;
  for (let split = 0; split < accuracy.splits && cells.length; split++) {
    let whole = 0;
    const open = [];
    for (const cell of cells) {
      if (accuracy.plain && cell.plain) { kept += keep(cell.face, cell.moments); continue; }
      cell.kids = halves4(cell.corners).map((corners) => cellOf(cell.face, corners));
      cell.fine = new Float64Array(12);
      for (const kid of cell.kids) for (let n = 0; n < 12; n++) cell.fine[n] += kid.moments[n];
      cell.error = 0;
      for (let k = 0; k < 12; k += 4) {
        cell.error += Math.abs(cell.fine[k] - cell.moments[k]);
        whole += cell.fine[k];
      }
      open.push(cell);
    }
    open.sort((one, other) => one.error - other.error);
    whole += kept;
    let left = 0;
    cells = [];
    for (const cell of open) {
      left += cell.error;
      if (left > accuracy.tolerance * whole) cells.push(...cell.kids);
      else kept += keep(cell.face, cell.fine);
    }
  }
  for (const cell of cells) keep(cell.face, cell.moments);
  return surface.fluxOf(moments, 4);
}

// F_t at 4096 square roots of the cosine, between which it is linear: a look-up for thousands of points.
function fresnelTable(boundary, count = 4096) {
  return Float32Array.from({ length: count }, (_, n) => transmittance(boundary, (n / (count - 1)) ** 2));
}

function lookUp(table, cosine) {
  const at = Math.sqrt(Math.min(cosine, 1)) * (table.length - 1), n = Math.min(Math.floor(at), table.length - 2);
  return table[n] + (at - n) * (table[n + 1] - table[n]);
}

// Cells fine enough that no structure of the light is missed; none where all of a face looks away.
function firstCells(surface, light, accuracy, cellOf) {
  const cells = [], longest = surface.size / accuracy.coarse, towards = light.kind === "projector" ? null : unit(light.direction).map((x) => -x);
  for (let face = 0; face < surface.F; face++) {
    if (towards && dot(towards, surface.normal(face)) <= 0) continue;
    const p = surface.corners(face), todo = [[1, 0, 0, 0, 1, 0, 0, 0, 1]];
    while (todo.length) {
      const corners = todo.pop();
      const at = [0, 3, 6].map((n) =>
        [0, 1, 2].map((k) => corners[n] * p[0][k] + corners[n + 1] * p[1][k] + corners[n + 2] * p[2][k]));
      const length = Math.max(...at.map((a, k) => Math.hypot(...minus(a, at[(k + 1) % 3]))));
      const centre = [0, 1, 2].map((k) => (at[0][k] + at[1][k] + at[2][k]) / 3);
      if (length > Math.min(longest, finest(light, centre, length) / accuracy.detail)) todo.push(...halves4(corners));
      else cells.push(cellOf(face, corners));
    }
  }
  return cells;
}

// A triangle's four children of half its size, each as 9 numbers.
function halves4(c) {
  const ab = [], bc = [], ca = [];
  for (let k = 0; k < 3; k++) {
    ab[k] = (c[k] + c[3 + k]) / 2; bc[k] = (c[3 + k] + c[6 + k]) / 2; ca[k] = (c[k] + c[6 + k]) / 2;
  }
  const a = [c[0], c[1], c[2]], b = [c[3], c[4], c[5]], d = [c[6], c[7], c[8]];
  return [[...a, ...ab, ...ca], [...ab, ...b, ...bc], [...ca, ...bc, ...d], [...ab, ...bc, ...ca]];
}
