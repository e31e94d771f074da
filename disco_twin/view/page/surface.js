"use strict";
// The mesh: flat faces, hat functions, rays. As pipeline/geometry/mesh.py. Positions in mm.

const CREASE = Math.cos(Math.PI / 6); // between a vertex's normal and a triangle's
const OFFSET = 1e-5; // of the mesh's size: shadow rays start this far above the face
const LEAF = 4; // triangles

class Surface {
  // points: 3 V numbers; faces: 3 F; vertexNormals: 3 V, unit
  constructor(points, faces, vertexNormals) {
    Object.assign(this, { points, faces, vertexNormals });
    this.V = points.length / 3;
    this.F = faces.length / 3;
    this.normals = new Float64Array(3 * this.F);
    this.areas = new Float64Array(this.F);
    this.vertexAreas = new Float64Array(this.V);
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (let n = 0; n < points.length; n++) {
      low[n % 3] = Math.min(low[n % 3], points[n]);
      high[n % 3] = Math.max(high[n % 3], points[n]);
    }
    this.centre = low.map((x, k) => (x + high[k]) / 2);
    this.size = Math.hypot(high[0] - low[0], high[1] - low[1], high[2] - low[2]);
    for (let f = 0; f < this.F; f++) {
      const [a, b, c] = this.corners(f);
      const n = cross(minus(b, a), minus(c, a)), twice = Math.hypot(...n);
      this.areas[f] = twice / 2;
      for (let k = 0; k < 3; k++) {
        this.normals[3 * f + k] = n[k] / (twice || 1);
        this.vertexAreas[faces[3 * f + k]] += twice / 6;
      }
    }
    this.buildTree();
  }

  point(v) { return [this.points[3 * v], this.points[3 * v + 1], this.points[3 * v + 2]]; }
  corners(f) { return [0, 1, 2].map((k) => this.point(this.faces[3 * f + k])); }
  normal(f) { return [this.normals[3 * f], this.normals[3 * f + 1], this.normals[3 * f + 2]]; }

  // 3 numbers: the unit normal at a face's corner, the vertex's, or the face's own at a crease
  cornerNormal(f, k) {
    const v = this.faces[3 * f + k], flat = this.normal(f);
    const smooth = [this.vertexNormals[3 * v], this.vertexNormals[3 * v + 1], this.vertexNormals[3 * v + 2]];
    return dot(smooth, flat) < CREASE ? flat : smooth;
  }

  // Unit normal at barycentric coordinates of a face.
  smoothNormal(f, weights) {
    const sum = [0, 0, 0];
    for (let k = 0; k < 3; k++) this.cornerNormal(f, k).forEach((x, axis) => { sum[axis] += weights[k] * x; });
    return unit(sum);
  }

  // ---- a tree of boxes: node n has its box in box[6 n ..], children at `first[n]` and the one after it, or, where
  // count[n] > 0, that many triangles from order[first[n]]

  buildTree() {
    const F = this.F, middle = new Float64Array(3 * F);
    this.order = Uint32Array.from({ length: F }, (_, f) => f);
    for (let f = 0; f < F; f++) {
      const [a, b, c] = this.corners(f);
      for (let k = 0; k < 3; k++) middle[3 * f + k] = a[k] + b[k] + c[k];
    }
    this.box = new Float64Array(12 * F + 6);
    this.first = new Uint32Array(2 * F + 1);
    this.count = new Uint32Array(2 * F + 1);
    let used = 1;
    const split = (node, start, end) => {
      const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
      for (let n = start; n < end; n++)
        for (const p of this.corners(this.order[n]))
          for (let k = 0; k < 3; k++) { low[k] = Math.min(low[k], p[k]); high[k] = Math.max(high[k], p[k]); }
      for (let k = 0; k < 3; k++) { this.box[6 * node + k] = low[k]; this.box[6 * node + 3 + k] = high[k]; }
      if (end - start <= LEAF) { this.first[node] = start; this.count[node] = end - start; return; }
      const wide = [0, 1, 2].reduce((a, b) => (high[b] - low[b] > high[a] - low[a] ? b : a));
      this.order.subarray(start, end).sort((f, g) => middle[3 * f + wide] - middle[3 * g + wide]);
      const half = (start + end) >> 1, left = used;
      used += 2;
      this.first[node] = left;
      split(left, start, half);
      split(left + 1, half, end);
    };
    split(0, 0, F);
    this.stack = new Uint32Array(64);
  }

  // Where a ray from o along unit d first meets the surface: {face, weights, distance}, null where it does not.
  // any: only whether it meets it at all.
  trace(ox, oy, oz, dx, dy, dz, any) {
    const { box, first, count, order, points: p, faces, stack } = this;
    const ix = 1 / dx, iy = 1 / dy, iz = 1 / dz;
    let best = Infinity, hit = -1, bu = 0, bv = 0, top = 0;
    stack[top++] = 0;
    while (top) {
      const node = stack[--top], b = 6 * node;
      let t0 = (box[b] - ox) * ix, t1 = (box[b + 3] - ox) * ix, near = Math.min(t0, t1), far = Math.max(t0, t1);
      t0 = (box[b + 1] - oy) * iy; t1 = (box[b + 4] - oy) * iy;
      near = Math.max(near, Math.min(t0, t1)); far = Math.min(far, Math.max(t0, t1));
      t0 = (box[b + 2] - oz) * iz; t1 = (box[b + 5] - oz) * iz;
      near = Math.max(near, Math.min(t0, t1)); far = Math.min(far, Math.max(t0, t1));
      if (far < Math.max(near, 0) || near > best) continue;
      if (!count[node]) { stack[top++] = first[node]; stack[top++] = first[node] + 1; continue; }
      for (let n = first[node]; n < first[node] + count[node]; n++) {
        const f = order[n], a = 3 * faces[3 * f], q = 3 * faces[3 * f + 1], r = 3 * faces[3 * f + 2];
        const ax = p[a], ay = p[a + 1], az = p[a + 2];
        const e1x = p[q] - ax, e1y = p[q + 1] - ay, e1z = p[q + 2] - az;
        const e2x = p[r] - ax, e2y = p[r + 1] - ay, e2z = p[r + 2] - az;
        const hx = dy * e2z - dz * e2y, hy = dz * e2x - dx * e2z, hz = dx * e2y - dy * e2x;
        const det = e1x * hx + e1y * hy + e1z * hz;
        if (Math.abs(det) < 1e-14) continue;
        const sx = ox - ax, sy = oy - ay, sz = oz - az, u = (sx * hx + sy * hy + sz * hz) / det;
        if (u < 0 || u > 1) continue;
        const cx = sy * e1z - sz * e1y, cy = sz * e1x - sx * e1z, cz = sx * e1y - sy * e1x;
        const v = (dx * cx + dy * cy + dz * cz) / det;
        if (v < 0 || u + v > 1) continue;
        const t = (e2x * cx + e2y * cy + e2z * cz) / det;
        if (t <= 0 || t >= best) continue;
        if (any) return true;
        best = t; hit = f; bu = u; bv = v;
      }
    }
    if (any) return false;
    return hit < 0 ? null : { face: hit, weights: [1 - bu - bv, bu, bv], distance: best };
  }

  // Solves M x = b for `count` right sides side by side, b[count * v + c], with the hat functions' mass matrix M, and
  // multiplies by the vertices' areas: flux from moments (pipeline/relight/irradiance.py, flux_of).
  fluxOf(moments, count) {
    const { V, F, faces, areas } = this, size = V * count, out = new Float64Array(size);
    const times = (x) => {
      const y = new Float64Array(size);
      for (let f = 0; f < F; f++) {
        const s = areas[f] / 12, a = count * faces[3 * f], b = count * faces[3 * f + 1], c = count * faces[3 * f + 2];
        for (let k = 0; k < count; k++) {
          const sum = s * (x[a + k] + x[b + k] + x[c + k]);
          y[a + k] += sum + s * x[a + k]; y[b + k] += sum + s * x[b + k]; y[c + k] += sum + s * x[c + k];
        }
      }
      return y;
    };
    const r = Float64Array.from(moments), p = new Float64Array(size), z = new Float64Array(size);
    const precondition = () => { for (let n = 0; n < size; n++) z[n] = r[n] / this.vertexAreas[Math.floor(n / count)]; };
    const sum = (x, y) => { let s = 0; for (let n = 0; n < size; n++) s += x[n] * y[n]; return s; };
    precondition();
    p.set(z);
    let rz = sum(r, z);
    const enough = 1e-14 * rz;
    for (let step = 0; step < 60 && rz > enough; step++) {
      const q = times(p), alpha = rz / sum(p, q);
      for (let n = 0; n < size; n++) { out[n] += alpha * p[n]; r[n] -= alpha * q[n]; }
      precondition();
      const next = sum(r, z);
      for (let n = 0; n < size; n++) p[n] = z[n] + (next / rz) * p[n];
      rz = next;
    }
    for (let n = 0; n < size; n++) out[n] *= this.vertexAreas[Math.floor(n / count)];
    return out;
  }
}

function dot(a, b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
function minus(a, b) { return [a[0] - b[0], a[1] - b[1], a[2] - b[2]]; }
function plus(a, b, s = 1) { return [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]]; }
function cross(a, b) { return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]; }
function unit(a) { const s = Math.hypot(a[0], a[1], a[2]) || 1; return [a[0] / s, a[1] / s, a[2] / s]; }
