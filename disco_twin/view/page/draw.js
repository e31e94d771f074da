"use strict";
// WebGL2: radiosity and its moments to linear radiance, then to display values. Lasers in r, g, b.

const MESH_VERTEX = `#version 300 es
layout(location = 0) in vec3 point;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec3 radiosity;
layout(location = 3) in vec3 along0;
layout(location = 4) in vec3 along1;
layout(location = 5) in vec3 along2;
uniform mat4 toClip;
out vec3 at, facing, leaves, ahead0, ahead1, ahead2;
void main() {
  at = point; facing = normal; leaves = radiosity; ahead0 = along0; ahead1 = along1; ahead2 = along2;
  gl_Position = toClip * vec4(point, 1.0);
}`;

// L = F_t(cos) / pi (B + t . m): pipeline/relight/on_mesh.py. flat: the values themselves.
const MESH_FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler2D;
in vec3 at, facing, leaves, ahead0, ahead1, ahead2;
uniform vec3 eye;
uniform float eta;
uniform bool flatValues;
uniform sampler2D fresnel;
out vec4 radiance;
void main() {
  if (flatValues) { radiance = vec4(leaves, 1.0); return; }
  vec3 n = normalize(facing), d = normalize(eye - at);
  float c = dot(d, n);
  vec3 t = (d - c * n) / eta;
  float x = sqrt(clamp(c, 0.0, 1.0)) * 4095.0, k = min(floor(x), 4094.0);
  ivec2 low = ivec2(int(k) % 64, int(k) / 64), high = ivec2((int(k) + 1) % 64, (int(k) + 1) / 64);
  float f = mix(texelFetch(fresnel, low, 0).r, texelFetch(fresnel, high, 0).r, x - k);
  radiance = vec4(f / 3.14159265358979 * (leaves + vec3(dot(t, ahead0), dot(t, ahead1), dot(t, ahead2))), 1.0);
}`;

const SCREEN_VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;

// mode 0: natural; 1: false colour of log10, by laser or mean; 2: difference to `other`, as a share of white
const SCREEN_FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler2D;
uniform sampler2D image, other;
uniform ivec2 corner;
uniform int mode, samples, laser, lasers, imageRows, otherRows;
uniform ivec2 skipped;
uniform float white, decades, span, zoom;
uniform vec3 ramp[7];
uniform vec3 ground;
out vec4 colour;
// rows: of a picture that is stored from its top, else 0
vec4 average(sampler2D from, ivec2 p, int s, int rows) {
  vec4 sum = vec4(0.0);
  if (rows > 0) p.y = rows - 1 - p.y;
  for (int y = 0; y < s; y++) for (int x = 0; x < s; x++) sum += texelFetch(from, p * s + ivec2(x, y), 0);
  return sum / float(s * s);
}
float one(vec3 v) {
  if (laser >= 0) return v[laser];
  return lasers == 1 ? v.r : lasers == 2 ? (v.r + v.g) / 2.0 : (v.r + v.g + v.b) / 3.0;
}
vec3 ramped(float x) {
  float at = clamp(x, 0.0, 1.0) * 6.0; int k = min(int(at), 5);
  return mix(ramp[k], ramp[k + 1], at - float(k));
}
void main() {
  ivec2 p = skipped + ivec2(floor((gl_FragCoord.xy - vec2(corner)) / zoom));
  vec4 value = average(image, p, samples, imageRows);
  if (value.a <= 0.0) { colour = vec4(ground, 1.0); return; }
  vec3 shown;
  if (mode == 1) shown = ramped(1.0 + log(max(one(value.rgb), 1e-30) / white) / log(10.0) / decades);
  else if (mode == 2) {
    vec4 reference = average(other, p, 1, otherRows);
    float x = reference.a > 0.5 ? clamp(one(value.rgb - reference.rgb) / white / span, -1.0, 1.0) : 0.0;
    shown = x > 0.0 ? mix(vec3(0.96), vec3(0.75, 0.32, 0.02), x) : mix(vec3(0.96), vec3(0.05, 0.30, 0.62), -x);
    if (reference.a <= 0.5) shown = ground;
  } else shown = pow(clamp((lasers == 1 ? value.rrr : value.rgb) / white, 0.0, 1.0), vec3(1.0 / 2.2));
  colour = vec4(mix(ground, shown, value.a), 1.0);
}`;

// Dark to bright in even steps of lightness, told apart by all kinds of colour vision.
const RAMP = [[4, 4, 22], [38, 26, 92], [104, 36, 116], [170, 58, 98], [222, 100, 66], [246, 166, 72], [252, 246, 190]];
const GROUND = [0.07, 0.075, 0.085];

class Painter {
  // Raises: Error where the browser has no WebGL2, or none that draws numbers.
  constructor(canvas, surface, head) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("no WebGL2");
    if (!gl.getExtension("EXT_color_buffer_float")) throw new Error("WebGL2 without pictures of 32-bit numbers");
    Object.assign(this, { gl, canvas, surface, head });
    this.mesh = this.program(MESH_VERTEX, MESH_FRAGMENT);
    this.screen = this.program(SCREEN_VERTEX, SCREEN_FRAGMENT);
    const F = surface.F, still = new Float32Array(18 * F);
    for (let f = 0; f < F; f++)
      for (let k = 0; k < 3; k++) {
        still.set(surface.point(surface.faces[3 * f + k]), 18 * f + 6 * k);
        still.set(surface.cornerNormal(f, k), 18 * f + 6 * k + 3);
      }
    this.values = new Float32Array(36 * F);
    this.shape = gl.createVertexArray();
    gl.bindVertexArray(this.shape);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, still, gl.STATIC_DRAW);
    this.attribute(0, 24, 0); this.attribute(1, 24, 12);
    this.changing = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.changing);
    gl.bufferData(gl.ARRAY_BUFFER, this.values, gl.DYNAMIC_DRAW);
    for (let n = 0; n < 4; n++) this.attribute(2 + n, 48, 12 * n);
    this.empty = gl.createVertexArray();
    this.fresnel = this.floatTexture(64, 64, null);
    this.setBoundary(head.boundary);
    this.target = null;
  }

  program(vertex, fragment) {
    const gl = this.gl, made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    const where = {};
    return { made, at: (name) => (where[name] ??= gl.getUniformLocation(made, name)) };
  }

  attribute(index, stride, offset) {
    this.gl.enableVertexAttribArray(index);
    this.gl.vertexAttribPointer(index, 3, this.gl.FLOAT, false, stride, offset);
  }

  floatTexture(width, height, data) {
    const gl = this.gl, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, width, height, 0, gl.RGBA, gl.FLOAT, data);
    for (const what of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, what, gl.NEAREST);
    return texture;
  }

  setBoundary(boundary) {
    const gl = this.gl, table = fresnelTable(boundary), data = new Float32Array(4 * table.length);
    table.forEach((f, n) => { data[4 * n] = f; });
    gl.bindTexture(gl.TEXTURE_2D, this.fresnel);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 64, 64, gl.RGBA, gl.FLOAT, data);
    this.eta = boundary.eta;
  }

  // by laser, 4 numbers a vertex: radiosity and its moments
  setValues(byLaser) {
    const { faces } = this.surface, gl = this.gl, out = this.values.fill(0);
    for (let n = 0; n < faces.length; n++)
      for (let laser = 0; laser < byLaser.length; laser++) {
        const from = 4 * faces[n], own = byLaser[laser];
        out[12 * n + laser] = own[from];
        for (let k = 0; k < 3; k++) out[12 * n + 3 + 3 * laser + k] = own[from + 1 + k];
      }
    gl.bindBuffer(gl.ARRAY_BUFFER, this.changing);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, out);
  }

  // camera: {width, height, focal, centre, pose} -> linear radiance in this.target, samples^2 points a pixel
  renderRadiance(camera, samples, flatValues = false) {
    const gl = this.gl, width = Math.round(camera.width * samples), height = Math.round(camera.height * samples);
    if (!this.target || this.target.width !== width || this.target.height !== height) {
      if (this.target) { gl.deleteTexture(this.target.texture); gl.deleteFramebuffer(this.target.frame); gl.deleteRenderbuffer(this.target.depth); }
      const texture = this.floatTexture(width, height, null), frame = gl.createFramebuffer(), depth = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, depth);
      gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
      gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depth);
      this.target = { texture, frame, depth, width, height };
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.frame);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.enable(gl.DEPTH_TEST);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const { made, at } = this.mesh;
    gl.useProgram(made);
    gl.uniformMatrix4fv(at("toClip"), false, clipMatrix(camera, this.surface));
    gl.uniform3fv(at("eye"), eyeOf(camera.pose));
    gl.uniform1f(at("eta"), this.eta);
    gl.uniform1i(at("flatValues"), flatValues ? 1 : 0);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.fresnel);
    gl.uniform1i(at("fresnel"), 0);
    gl.bindVertexArray(this.shape);
    gl.drawArrays(gl.TRIANGLES, 0, 3 * this.surface.F);
    return { texture: this.target.texture, samples, rows: 0 };
  }

  // Draws an image into a rectangle of the canvas (x, y from the lower left), each of its pixels zoom^2 large, beginning
  // with its pixel `skipped` from the lower left.
  // image, other: {texture, samples: points a side of a pixel, rows: of a picture that is stored from its top, else 0}
  // look: {mode, white, decades, laser, span}
  present(image, [x, y, width, height], look, { zoom = 1, skipped = [0, 0], other = image } = {}) {
    const gl = this.gl, { made, at } = this.screen;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(x, y, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(x, y, width, height);
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(made);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, image.texture);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, other.texture);
    const whole = {
      image: 0, other: 1, mode: look.mode, samples: image.samples, laser: look.laser, lasers: this.head.lasers,
      imageRows: image.rows, otherRows: other.rows,
    };
    for (const [name, value] of Object.entries(whole)) gl.uniform1i(at(name), value);
    for (const name of ["white", "decades", "span"]) gl.uniform1f(at(name), look[name]);
    gl.uniform1f(at("zoom"), zoom);
    gl.uniform2i(at("corner"), x, y);
    gl.uniform2i(at("skipped"), ...skipped);
    gl.uniform3fv(at("ramp"), RAMP.flat().map((v) => v / 255));
    gl.uniform3fv(at("ground"), GROUND);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.SCISSOR_TEST);
  }

  // Numbers of a view: {width, height, radiance: r g b coverage by pixel, from the top}, each the mean of samples^2 points
  readRadiance(camera, samples = 4) {
    this.renderRadiance(camera, samples);
    const gl = this.gl, { width, height } = this.target, raw = new Float32Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, raw);
    const out = new Float32Array(4 * camera.width * camera.height);
    for (let y = 0; y < height; y++)
      for (let x = 0; x < width; x++) {
        const row = camera.height - 1 - Math.floor(y / samples), to = 4 * (row * camera.width + Math.floor(x / samples));
        for (let c = 0; c < 4; c++) out[to + c] += raw[4 * (y * width + x) + c] / samples ** 2;
      }
    return { width: camera.width, height: camera.height, radiance: out };
  }
}

// Pixel coordinates (x, y) of a point, y from the top.
function project({ pose, focal, centre }, point) {
  const [x, y, z] = pose.slice(0, 3).map((row) => dot(row, point) + row[3]);
  return [(focal[0] * x) / z + centre[0], (focal[1] * y) / z + centre[1]];
}

function eyeOf(pose) {
  return [0, 1, 2].map((k) => -(pose[0][k] * pose[0][3] + pose[1][k] * pose[1][3] + pose[2][k] * pose[2][3]));
}

// Object frame to clip space, column by column, for a pinhole camera that looks along its +z, x right, y down.
function clipMatrix(camera, surface) {
  const { width, height, focal, centre, pose } = camera, middle = surface.centre, half = 0.6 * surface.size;
  const depth = [0, 1, 2, 3].map((k) => pose[2][k]), away = dot(depth, middle) + depth[3];
  const near = Math.max(away - half, 0.02 * half), far = away + half;
  const rows = [
    [0, 1, 2, 3].map((k) => (2 * focal[0] / width) * pose[0][k] + (2 * centre[0] / width - 1) * depth[k]),
    [0, 1, 2, 3].map((k) => -(2 * focal[1] / height) * pose[1][k] - (2 * centre[1] / height - 1) * depth[k]),
    [0, 1, 2, 3].map((k) => ((far + near) / (far - near)) * depth[k] - (k === 3 ? (2 * far * near) / (far - near) : 0)),
    depth,
  ];
  return new Float32Array([0, 1, 2, 3].flatMap((k) => rows.map((row) => row[k])));
}
