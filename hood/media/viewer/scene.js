// What is drawn: cloth, bodies, the floor and the shadows on it.
import * as THREE from 'three';
import { normalsOf, positionsAt, spread, unpackBytes, unpackIntegers, unpackMapped, unpackMesh } from 'data';

const SKIN = 0xcdb5a3;
const BACKGROUND = [241, 242, 244];
const GROUND = [229, 230, 232];
const LINES = [212, 214, 218];

/** Cloth is drawn from both sides in one colour; with an image on it, or in the colours of its vertices. */
const clothMaterial = (map = null) =>
  new THREE.MeshStandardMaterial({ map, vertexColors: !map, side: THREE.DoubleSide, roughness: 0.85 });

/** Skin steps back in depth a little, so that cloth lying on it is not cut by it. */
const bodyMaterial = () => new THREE.MeshStandardMaterial({
  color: SKIN, side: THREE.DoubleSide, roughness: 0.9, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 2 });

/** Linear parts of colours whose parts are bytes, as the drawing library wants them. */
export function linear(bytes) {
  const parts = new Float32Array(bytes.length);
  const colour = new THREE.Color();
  for (let i = 0; i < bytes.length; i += 3) {
    colour.setRGB(bytes[i] / 255, bytes[i + 1] / 255, bytes[i + 2] / 255, THREE.SRGBColorSpace).toArray(parts, i);
  }
  return parts;
}

/** The scene with its lamp, and the floor at a height [m]. */
export function makeScene(height) {
  const scene = new THREE.Scene();
  scene.background = new THREE.Color().setRGB(...BACKGROUND.map((part) => part / 255), THREE.SRGBColorSpace);
  const lamp = new THREE.DirectionalLight(0xffffff, 2.4);
  scene.add(new THREE.HemisphereLight(0xffffff, 0xb0a8a0, 1.1), lamp, lamp.target);
  const floor = makeFloor(height);
  scene.add(floor);
  return { scene, lamp, floor };
}

const bytes = (parts) => `vec3(${parts.map((part) => (part / 255).toFixed(4))})`;

/** A disc that fades into the background, with a line every half metre; what stands on it is drawn over it. */
function makeFloor(height) {
  const material = new THREE.ShaderMaterial({
    depthTest: false, depthWrite: false,
    vertexShader: `varying vec3 at; varying vec2 off;
      void main() { at = (modelMatrix * vec4(position, 1.0)).xyz; off = position.xz;
        gl_Position = projectionMatrix * viewMatrix * vec4(at, 1.0); }`,
    fragmentShader: `varying vec3 at; varying vec2 off;
      void main() {
        vec2 cell = abs(fract(at.xz / 0.5 - 0.5) - 0.5) * 0.5 / max(fwidth(at.xz), vec2(1e-6));
        float line = 1.0 - min(min(cell.x, cell.y), 1.0);
        float far = smoothstep(0.8, 4.0, length(off));
        gl_FragColor = vec4(mix(mix(${bytes(GROUND)}, ${bytes(LINES)}, line * (1.0 - far)), ${bytes(BACKGROUND)}, far), 1.0); }`,
  });
  const floor = new THREE.Mesh(new THREE.PlaneGeometry(10, 10).rotateX(-Math.PI / 2), material);
  floor.position.y = height;
  floor.renderOrder = -2;
  return floor;
}

/** A mesh laid flat on the floor: dark where it is near it, faint where it is high above. The darkest of all counts. */
function shadowOf(geometry, height) {
  const material = new THREE.ShaderMaterial({
    side: THREE.DoubleSide, depthTest: false, depthWrite: false, blending: THREE.CustomBlending,
    blendEquation: THREE.MinEquation, blendSrc: THREE.OneFactor, blendDst: THREE.OneFactor,
    vertexShader: `centroid varying float above;
      void main() { above = max(position.y - ${height.toFixed(5)}, 0.0);
        vec3 at = vec3(position.x + 0.22 * above, ${height.toFixed(5)}, position.z - 0.12 * above);
        gl_Position = projectionMatrix * viewMatrix * vec4(at, 1.0); }`,
    fragmentShader: `centroid varying float above;
      void main() { float shade = 0.11 * exp(-max(above, 0.0) / 1.2) + 0.32 * exp(-max(above, 0.0) / 0.1);
        gl_FragColor = vec4(${bytes(GROUND)} * (1.0 - shade), 1.0); }`,
  });
  const shadow = new THREE.Mesh(geometry, material);
  shadow.renderOrder = -1;
  shadow.frustumCulled = false;
  return shadow;
}

/** What is drawn of a mesh: its vertices, or the points of what is `mapped`, in groups of faces with one material each. */
function surface(mesh, material, mapped = null) {
  const geometry = new THREE.BufferGeometry();
  const width = mapped ? 3 * mapped.points.length : mesh.width;
  geometry.setAttribute('position', new THREE.BufferAttribute(new Float32Array(width), 3));
  geometry.setAttribute('color', new THREE.BufferAttribute(new Float32Array(width).fill(1), 3));
  geometry.setAttribute('normal', new THREE.BufferAttribute(new Float32Array(width), 3));
  geometry.setIndex(new THREE.BufferAttribute(new Uint32Array((mapped ?? mesh).faces), 1));
  if (mapped) geometry.setAttribute('uv', new THREE.BufferAttribute(mapped.uv, 2));
  const drawn = new THREE.Mesh(geometry, material);
  drawn.frustumCulled = false;
  return drawn;
}

/** Everything of one rollout that is drawn. */
export async function makeActor(rollout, first, images, height) {
  const cloth = await unpackMesh(rollout.cloth);
  const body = rollout.body ? await unpackMesh(rollout.body) : first.body;
  const made = { rollout, cloth, body, lost: new Set(rollout.lost), group: new THREE.Group(), values: {} };
  for (const name of Object.keys(rollout.values)) made.values[name] = await unpackBytes(rollout.values[name]);
  made.fabric = linear(await unpackBytes(rollout.fabric));
  made.mapped = rollout.mapped ? await unpackMapped(rollout.mapped) : null;
  made.parts = await unpackIntegers(rollout.parts.of);
  made.coloured = clothMaterial();
  made.textured = made.mapped?.groups.map(([, image]) => (image === null ? made.coloured : clothMaterial(images[image])));
  made.clothMesh = surface(cloth, made.coloured, made.mapped);
  if (made.mapped) {
    made.vertices = { position: new Float32Array(cloth.width), normal: new Float32Array(cloth.width) };
    const fabric = made.fabric;
    made.fabric = new Float32Array(3 * made.mapped.points.length);
    spread(fabric, made.mapped.points, made.fabric);
  }
  made.bodyMesh = surface(body, bodyMaterial());
  made.clothShadow = shadowOf(made.clothMesh.geometry, height);
  made.bodyShadow = shadowOf(made.bodyMesh.geometry, height);
  made.group.add(made.bodyShadow, made.clothShadow, made.clothMesh, made.bodyMesh);
  hide(made, new Set());
  return made;
}

/** Draw the faces of the cloth but those of the parts with the names `hidden`. */
export function hide(made, hidden) {
  const { geometry } = made.clothMesh;
  const faces = (made.mapped ?? made.cloth).faces;
  const gone = made.rollout.parts.names.map((name) => hidden.has(name));
  const kept = new Uint32Array(faces.length);
  let count = 0;
  const add = (face) => {
    if (gone[made.parts[face]]) return;
    for (let k = 0; k < 3; k++) kept[count++] = faces[3 * face + k];
  };
  geometry.clearGroups();
  let face = 0;
  (made.mapped?.groups ?? [[faces.length / 3]]).forEach(([number], at) => {
    const start = count;
    for (const end = face + number; face < end; face++) add(face);
    if (made.mapped) geometry.addGroup(start, count - start, at);
  });
  geometry.setIndex(new THREE.BufferAttribute(kept.slice(0, count), 1));
}

/** One colour, three linear parts, for the whole cloth, or with null that of its fabrics. */
export function dye(made, tint) {
  const target = made.clothMesh.geometry.attributes.color;
  if (tint) for (let i = 0; i < target.array.length; i++) target.array[i] = tint[i % 3];
  else target.array.set(made.fabric);
  target.needsUpdate = true;
}

/** Colours of the cloth's vertices by the codes of their values, which begin at `start`. */
export function paint(made, codes, start, table) {
  const target = made.clothMesh.geometry.attributes.color;
  const points = made.mapped?.points;
  const out = target.array;
  for (let i = 0; i < out.length / 3; i++) {
    const place = 3 * codes[start + (points ? points[i] : i)];
    out[3 * i] = table[place];
    out[3 * i + 1] = table[place + 1];
    out[3 * i + 2] = table[place + 2];
  }
  target.needsUpdate = true;
}

/** Move what is drawn of a mesh to a frame; points share the normal of their vertex, found in arrays of the `vertices`. */
export function pose(drawn, mesh, frame, mapped = null, vertices = null) {
  const { position, normal } = drawn.geometry.attributes;
  const at = vertices?.position ?? position.array;
  const turned = vertices?.normal ?? normal.array;
  positionsAt(mesh, frame, at);
  normalsOf(at, mesh.faces, turned);
  if (mapped) {
    spread(at, mapped.points, position.array);
    spread(turned, mapped.points, normal.array);
  }
  position.needsUpdate = normal.needsUpdate = true;
}

/** An image that repeats beyond its borders, and is sharp when seen from the side. */
export async function loadImage(address, renderer) {
  const image = await new THREE.TextureLoader().loadAsync(address);
  image.wrapS = image.wrapT = THREE.RepeatWrapping;
  image.colorSpace = THREE.SRGBColorSpace;
  image.anisotropy = renderer.capabilities.getMaxAnisotropy();
  return image;
}
