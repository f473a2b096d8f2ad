// What the page holds, unpacked: the counterpart of page.py.

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

/** What is drawn where garments have images: vertices of the points, faces over points and texture coordinates. */
export async function unpackMapped(packed) {
  const [points, faces, steps] = await Promise.all([packed.points, packed.faces, packed.uv].map(unpackIntegers));
  return { points, faces, uv: Float32Array.from(steps, (value) => value * packed.step), groups: packed.groups };
}

/** Triples of vertices as those of the points that are drawn: a vertex on a seam of a texture is several points. */
export function spread(values, points, target) {
  for (let i = 0; i < points.length; i++) {
    for (let k = 0; k < 3; k++) target[3 * i + k] = values[3 * points[i] + k];
  }
}

/** Positions [m] of a frame into `target`; beyond the last frame those of the last. */
export function positionsAt(mesh, frame, target) {
  const start = Math.min(frame, mesh.frames - 1) * mesh.width;
  for (let i = 0; i < mesh.width; i++) target[i] = mesh.whole[start + i] * mesh.step;
}

/** Unit normals of the vertices into `target`, the mean of the faces around by their areas. */
export function normalsOf(at, faces, target) {
  target.fill(0);
  for (let f = 0; f < faces.length; f += 3) {
    const a = 3 * faces[f], b = 3 * faces[f + 1], c = 3 * faces[f + 2];
    const ux = at[b] - at[a], uy = at[b + 1] - at[a + 1], uz = at[b + 2] - at[a + 2];
    const vx = at[c] - at[a], vy = at[c + 1] - at[a + 1], vz = at[c + 2] - at[a + 2];
    const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
    target[a] += x; target[a + 1] += y; target[a + 2] += z;
    target[b] += x; target[b + 1] += y; target[b + 2] += z;
    target[c] += x; target[c + 1] += y; target[c + 2] += z;
  }
  for (let i = 0; i < target.length; i += 3) {
    const scale = 1 / (Math.sqrt(target[i] ** 2 + target[i + 1] ** 2 + target[i + 2] ** 2) || 1);
    target[i] *= scale; target[i + 1] *= scale; target[i + 2] *= scale;
  }
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
