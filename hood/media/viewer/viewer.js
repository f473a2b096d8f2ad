// Draws the rollouts of the page, lets the user turn and play them, and keeps the chart in step.
import * as THREE from 'three';
import { OrbitControls } from 'orbit';
import { middleAt, normalsOf, positionsAt, spread, unpackBytes, unpackMapped, unpackMesh } from 'data';
import { drawChart, figureNames, frameUnder, placeOf, rowsOf } from 'figures';

const byId = (id) => document.getElementById(id);
const content = JSON.parse(byId('content').textContent);
const PLAIN = [184, 189, 199];
const SKIN = 0xcdb5a3;
const OVERLAID = [null, [217, 115, 51], [77, 140, 89], [158, 71, 107]];
const ROW = 20; // pixels from one row of labels to the next
const state = { frame: 0, playing: false, since: 0 };

/** Cloth is drawn from both sides, the inside darker; with an image on it, or in the colours of its vertices. */
function clothMaterial(map = null) {
  const material = new THREE.MeshStandardMaterial({ map, vertexColors: !map, side: THREE.DoubleSide, roughness: 0.85 });
  material.onBeforeCompile = (shader) => {
    shader.fragmentShader = shader.fragmentShader.replace(
      '#include <color_fragment>', '#include <color_fragment>\nif (!gl_FrontFacing) diffuseColor.rgb *= 0.6;');
  };
  return material;
}

/** Skin steps back in depth a little, so that cloth lying on it is not cut by it. */
function bodyMaterial() {
  return new THREE.MeshStandardMaterial({
    color: SKIN, side: THREE.DoubleSide, roughness: 0.9, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 2 });
}

/** What is drawn of a mesh: its vertices, or the points of what is `mapped`, in groups of faces with one material each. */
function surface(mesh, material, mapped = null) {
  const geometry = new THREE.BufferGeometry();
  const width = mapped ? 3 * mapped.points.length : mesh.width;
  geometry.setAttribute('position', new THREE.BufferAttribute(new Float32Array(width), 3));
  geometry.setAttribute('color', new THREE.BufferAttribute(new Float32Array(width).fill(1), 3));
  geometry.setAttribute('normal', new THREE.BufferAttribute(new Float32Array(width), 3));
  geometry.setIndex(new THREE.BufferAttribute(new Uint32Array((mapped ?? mesh).faces), 1));
  if (mapped) {
    geometry.setAttribute('uv', new THREE.BufferAttribute(mapped.uv, 2));
    let start = 0;
    mapped.groups.forEach(([count], at) => { geometry.addGroup(3 * start, 3 * count, at); start += count; });
  }
  const drawn = new THREE.Mesh(geometry, material);
  drawn.frustumCulled = false;
  return drawn;
}

/** Everything of one rollout that is drawn. */
async function actor(rollout, first) {
  const cloth = await unpackMesh(rollout.cloth);
  const body = rollout.body ? await unpackMesh(rollout.body) : first.body;
  const made = { rollout, cloth, body, lost: new Set(rollout.lost), group: new THREE.Group() };
  made.values = {};
  for (const name of Object.keys(rollout.values)) made.values[name] = await unpackBytes(rollout.values[name]);
  made.fabric = linear(await unpackBytes(rollout.fabric));
  made.mapped = rollout.mapped ? await unpackMapped(rollout.mapped) : null;
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
  made.group.add(made.clothMesh, made.bodyMesh);
  return made;
}

/** Linear parts of colours whose parts are bytes, as the drawing library wants them. */
function linear(bytes) {
  const parts = new Float32Array(bytes.length);
  const colour = new THREE.Color();
  for (let i = 0; i < bytes.length; i += 3) {
    colour.setRGB(bytes[i] / 255, bytes[i + 1] / 255, bytes[i + 2] / 255, THREE.SRGBColorSpace).toArray(parts, i);
  }
  return parts;
}

/** Colours of the cloth's vertices that stay as they are, by what the user chose. */
function dye(made, at) {
  const target = made.clothMesh.geometry.attributes.color;
  const overlaid = byId('layout').value === 'over' ? OVERLAID[at % OVERLAID.length] : null;
  if (!overlaid && ['fabric', 'texture'].includes(byId('colour').value)) target.array.set(made.fabric);
  else {
    const tint = linear(overlaid ?? PLAIN);
    for (let i = 0; i < target.array.length; i++) target.array[i] = tint[i % 3];
  }
  target.needsUpdate = true;
}

/** Colours of the cloth's vertices by their values in a frame. */
function paint(made, frame, values) {
  const target = made.clothMesh.geometry.attributes.color;
  const points = made.mapped?.points;
  const start = (Math.min(frame, made.cloth.frames - 1) * made.cloth.width) / 3;
  const out = target.array;
  for (let i = 0; i < out.length / 3; i++) {
    const place = 3 * values[start + (points ? points[i] : i)];
    out[3 * i] = ramp[place];
    out[3 * i + 1] = ramp[place + 1];
    out[3 * i + 2] = ramp[place + 2];
  }
  target.needsUpdate = true;
}

/** Move what is drawn of a mesh to a frame; points share the normal of their vertex, found in arrays of the `vertices`. */
function pose(drawn, mesh, frame, mapped = null, vertices = null) {
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

const ramp = linear(content.ramp.flat());
const renderer = new THREE.WebGLRenderer({ canvas: byId('canvas'), antialias: true, preserveDrawingBuffer: true });
const scene = new THREE.Scene();
scene.background = new THREE.Color(0xf1f2f4);
const camera = new THREE.PerspectiveCamera(35, 1, 0.02, 200);
const controls = new OrbitControls(camera, byId('canvas'));
const lamp = new THREE.DirectionalLight(0xffffff, 2.4);
scene.add(new THREE.HemisphereLight(0xffffff, 0xb0a8a0, 1.1), lamp, lamp.target);
let actors = [];
let images = [];
let frames = 1;

/** Lay the scene out for a frame; the camera goes along with the body where it is to follow. */
function show(frame, moveCamera = true) {
  const before = actors[0].centres[state.frame];
  state.frame = frame;
  for (const made of actors) {
    const values = made.values[byId('colour').value];
    pose(made.clothMesh, made.cloth, frame, made.mapped, made.vertices);
    pose(made.bodyMesh, made.body, frame);
    if (values) paint(made, frame, values);
  }
  if (moveCamera && byId('follow').checked) {
    const shift = new THREE.Vector3(...actors[0].centres[frame]).sub(new THREE.Vector3(...before));
    camera.position.add(shift);
    controls.target.add(shift);
  }
  byId('time').value = frame;
  byId('frame').textContent = `frame ${frame} of ${frames - 1}, ${(frame * content.seconds).toFixed(2)} s`;
  const lost = actors.filter((made) => made.lost.has(frame)).map((made) => made.rollout.name);
  byId('said').textContent = lost.length ? `${lost.join(', ')}: no finite positions in this frame` : '';
  drawChart(byId('chart'), content.rollouts, byId('figure').value, frame, frames, content.moments);
}

/** One picture: a part of the canvas for every rollout, or all of them in one. */
function draw() {
  const { clientWidth: width, clientHeight: height } = byId('stage');
  const beside = byId('layout').value === 'beside';
  const parts = beside ? actors.map((made) => [made]) : [actors];
  camera.aspect = width / parts.length / height;
  camera.updateProjectionMatrix();
  lamp.position.set(-0.8, 1, 0.4).applyQuaternion(camera.quaternion).multiplyScalar(3).add(camera.position);
  lamp.target.position.copy(controls.target);
  renderer.setScissorTest(true);
  parts.forEach((shown, at) => {
    actors.forEach((made, i) => {
      made.group.visible = shown.includes(made);
      made.clothMesh.visible = !made.lost.has(state.frame);
      made.bodyMesh.visible = byId('body').checked && (beside || i === 0 || made.body !== actors[0].body);
    });
    renderer.setViewport((at * width) / parts.length, 0, width / parts.length, height);
    renderer.setScissor((at * width) / parts.length, 0, width / parts.length, height);
    renderer.render(scene, camera);
  });
}

function tick(now) {
  if (state.playing && now - state.since >= 1000 * content.seconds) {
    const steps = Math.floor((now - state.since) / (1000 * content.seconds));
    state.since += 1000 * content.seconds * steps;
    const next = state.frame + steps;
    if (next < frames) show(next);
    else if (byId('loop').checked) show(next % frames);
    else { show(frames - 1); play(false); }
  }
  controls.update();
  draw();
  requestAnimationFrame(tick);
}

function play(on) {
  if (on && state.frame === frames - 1) show(0);
  state.playing = on;
  state.since = performance.now();
  byId('play').textContent = on ? 'pause' : 'play';
}

function resize() {
  mark(); // its height is part of the page's
  renderer.setPixelRatio(window.devicePixelRatio);
  renderer.setSize(byId('stage').clientWidth, byId('stage').clientHeight, false);
  drawChart(byId('chart'), content.rollouts, byId('figure').value, state.frame, frames, content.moments);
}

/** A button that leads to the frame of an event, with its words. */
function momentButton({ frame, words }) {
  const button = document.createElement('button');
  button.textContent = words;
  button.title = `frame ${frame}, ${(frame * content.seconds).toFixed(2)} s`;
  button.onclick = () => show(frame);
  return button;
}

/** Put the buttons of events above their places in the chart, in as few rows as they need. */
function mark() {
  const wide = byId('moments').clientWidth;
  const buttons = [...byId('moments').children];
  const widths = buttons.map((button) => button.offsetWidth);
  const lefts = widths.map((width, at) => Math.max(0, Math.min(placeOf(wide, content.moments[at].frame, frames), wide - width)));
  const rows = rowsOf(lefts, widths);
  buttons.forEach((button, at) => {
    button.style.left = `${lefts[at]}px`;
    button.style.top = `${ROW * rows[at]}px`;
  });
  byId('moments').style.height = `${ROW * (1 + Math.max(-1, ...rows))}px`;
}

/** Save what is seen as a PNG. */
function still() {
  draw();
  const link = document.createElement('a');
  link.download = `${document.title.replace(/[^\w.-]+/g, '_')}_${state.frame}.png`;
  link.href = byId('canvas').toDataURL('image/png');
  link.click();
}

function dress() {
  const scale = content.scales.find((one) => one.name === byId('colour').value);
  const colours = content.ramp.slice(0, -1).filter((_, at) => at % 15 === 0).map((rgb) => `rgb(${rgb})`);
  byId('scale').style.display = scale ? 'block' : 'none';
  byId('scale').innerHTML = '<i></i><b></b>';
  byId('scale').firstChild.style.background = `linear-gradient(to right, ${colours})`;
  byId('scale').lastChild.textContent = scale ? `${scale.title}: ${scale.low} to ${scale.high}` : '';
  if (!scale) actors.forEach(dye);
  const beside = byId('layout').value === 'beside';
  byId('names').replaceChildren(...content.rollouts.map((rollout, at) => {
    const name = document.createElement('span');
    name.textContent = rollout.name;
    if (rollout.note) name.append(Object.assign(document.createElement('small'), { textContent: rollout.note }));
    if (!beside && OVERLAID[at % OVERLAID.length]) name.style.color = `rgb(${OVERLAID[at % OVERLAID.length].map((part) => 0.8 * part)})`;
    return name;
  }));
  actors.forEach((made, at) => {
    const plain = byId('layout').value === 'over' && OVERLAID[at % OVERLAID.length];
    const shown = made.textured && byId('colour').value === 'texture' && !plain ? made.textured : made.coloured;
    made.clothMesh.material = shown;
    for (const material of [shown].flat()) material.wireframe = byId('wire').checked;
  });
  show(state.frame, false);
}

function listen() {
  byId('play').onclick = () => play(!state.playing);
  byId('time').oninput = () => show(Number(byId('time').value));
  byId('still').onclick = still;
  for (const id of ['colour', 'layout', 'wire', 'figure']) byId(id).onchange = dress;
  byId('chart').onpointerdown = byId('chart').onpointermove = (event) => {
    if (event.buttons) show(frameUnder(byId('chart'), event.offsetX, frames));
  };
  window.onresize = resize;
  window.onkeydown = (event) => {
    if (event.key === ' ' && event.target === document.body) { play(!state.playing); event.preventDefault(); }
  };
}

/** What the camera follows: the first body, or the cloth where there is none. */
const guide = () => (actors[0].body.width ? actors[0].body : actors[0].cloth);

/** An image that repeats beyond its borders, and is sharp when seen from the side. */
async function loadImage(address) {
  const image = await new THREE.TextureLoader().loadAsync(address);
  image.wrapS = image.wrapT = THREE.RepeatWrapping;
  image.colorSpace = THREE.SRGBColorSpace;
  image.anisotropy = renderer.capabilities.getMaxAnisotropy();
  return image;
}

async function start() {
  images = await Promise.all(content.images.map(loadImage));
  for (const rollout of content.rollouts) actors.push(await actor(rollout, actors[0]));
  frames = Math.max(...actors.map((made) => made.cloth.frames));
  actors[0].centres = Array.from({ length: frames }, (_, at) => middleAt(guide(), at).middle);
  for (const made of actors) scene.add(made.group);
  byId('time').max = frames - 1;
  byId('two').hidden = actors.length < 2;
  if (images.length) {
    byId('colour').add(new Option('texture', 'texture'), 0);
    byId('colour').value = 'texture';
  }
  for (const { name, label } of content.scales) byId('colour').add(new Option(label, name));
  for (const [name, title] of figureNames(content.rollouts)) byId('figure').add(new Option(title, name));
  byId('moments').append(...content.moments.map(momentButton));
  if (!byId('figure').length) byId('chart').hidden = byId('which').hidden = true;
  const { middle, extent } = middleAt(guide(), 0);
  controls.target.set(...middle);
  camera.position.set(middle[0], middle[1] + 0.15 * extent, middle[2] + 1.7 * extent);
  resize();
  listen();
  dress();
  document.body.dataset.ready = 'yes';
  requestAnimationFrame(tick);
}

start().catch((error) => {
  byId('said').textContent = `this page cannot be shown: ${error.message}`;
  throw error;
});
