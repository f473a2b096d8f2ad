// What the page holds, unpacked: the counterpart of packing.py.

/** Bytes of deflated base64 text. */
export async function unpackBytes(text) {
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream('deflate'));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Signed integers from planes of bytes, the lowest first, with the sign in the lowest bit. */
export async function unpackIntegers(text) {
  const bytes = await unpackBytes(text);
  const count = bytes.length / 4;
  const values = new Int32Array(count);
  for (let i = 0; i < count; i++) {
    const folded = bytes[i] | (bytes[i + count] << 8) | (bytes[i + 2 * count] << 16) | (bytes[i + 3 * count] << 24);
    values[i] = (folded >>> 1) ^ -(folded & 1);
  }
  return values;
}

/** A mesh with `whole`: its positions of all frames in steps, summed up twice from their second differences. */
export async function unpackMesh(packed) {
  const whole = await unpackIntegers(packed.data);
  const width = 3 * packed.vertices;
  for (let pass = 0; pass < 2; pass++) {
    for (let i = width; i < whole.length; i++) whole[i] += whole[i - width];
  }
  return { frames: packed.frames, width, step: packed.step, whole, faces: await unpackIntegers(packed.faces) };
}

/** Positions [m] of a frame into `target`; beyond the last frame those of the last. */
export function positionsAt(mesh, frame, target) {
  const start = Math.min(frame, mesh.frames - 1) * mesh.width;
  for (let i = 0; i < mesh.width; i++) target[i] = mesh.whole[start + i] * mesh.step;
}

/** Middle [m] of a mesh in a frame: that of its box. */
export function middleAt(mesh, frame) {
  const start = Math.min(frame, mesh.frames - 1) * mesh.width;
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (let i = 0; i < mesh.width; i++) {
    const value = mesh.whole[start + i] * mesh.step;
    low[i % 3] = Math.min(low[i % 3], value);
    high[i % 3] = Math.max(high[i % 3], value);
  }
  return { middle: low.map((value, axis) => (value + high[axis]) / 2), extent: Math.hypot(...low.map((v, a) => high[a] - v)) };
}
