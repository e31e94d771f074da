"use strict";
// The page's data block: base64 of gzip of [4 bytes: length of the head][head: JSON][arrays, each from a multiple of 4].
// disco_twin/view/pack.py writes it.

// Numbers of half precision: 1 bit of sign, 5 of exponent, 10 of fraction.
function fromHalf(bits) {
  const sign = bits & 0x8000 ? -1 : 1, exponent = (bits >> 10) & 31, fraction = bits & 1023;
  if (exponent === 0) return sign * fraction * 2 ** -24;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
}

let halves = null;

// One array of the block as plain numbers. entry: {kind, shape, at, scale}
function readArray(bytes, entry) {
  const count = entry.shape.reduce((a, b) => a * b, 1), here = bytes.buffer, at = bytes.byteOffset + entry.at;
  if (entry.kind === "f4") return new Float32Array(here, at, count);
  if (entry.kind === "u4") return new Uint32Array(here, at, count);
  if (entry.kind === "u2") return new Uint16Array(here, at, count);
  if (entry.kind !== "f2") throw new Error("unknown kind of array: " + entry.kind);
  if (!halves) halves = Float32Array.from({ length: 65536 }, (_, bits) => fromHalf(bits));
  const stored = new Uint16Array(here, at, count), out = new Float32Array(count);
  for (let n = 0; n < count; n++) out[n] = halves[stored[n]] * entry.scale;
  return out;
}

// bytes: Uint8Array, unzipped -> {head, arrays by name}
function parseBlock(bytes) {
  const length = new DataView(bytes.buffer, bytes.byteOffset).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + length)));
  const arrays = {};
  for (const [name, entry] of Object.entries(head.arrays)) arrays[name] = readArray(bytes, entry);
  return { head, arrays };
}

// text: the block as it stands in the page
async function unpackBlock(text) {
  const packed = atob(text.trim()), bytes = new Uint8Array(packed.length);
  for (let n = 0; n < bytes.length; n++) bytes[n] = packed.charCodeAt(n);
  const unzipped = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return parseBlock(new Uint8Array(await new Response(unzipped).arrayBuffer()));
}
