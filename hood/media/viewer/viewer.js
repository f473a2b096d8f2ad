// Draws the rollouts of the page, lets the user turn and play them, and keeps the chart in step.
import * as THREE from 'three';
import { OrbitControls } from 'orbit';
import { middleAt, positionsAt, unpackBytes, unpackMesh } from 'data';
import { drawChart, figureNames, frameUnder } from 'figures';

const byId = (id) => document.getElementById(id);
const content = JSON.parse(byId('content').textContent);
const PLAIN = [0.72, 0.74, 0.78];
const SKIN = 0xcdb5a3;
const OVERLAID = [null, [0.85, 0.45, 0.2], [0.3, 0.55, 0.35], [0.62, 0.28, 0.42]];
const state = { frame: 0, playing: false, since: 0 };

/** Cloth is drawn from both sides, the inside darker. */
function clothMaterial() {
  const material = new THREE.MeshStandardMaterial({ vertexColors: true, side: THREE.DoubleSide, roughness: 0.85 });
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

function surface(mesh, material) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute('position', new THREE.BufferAttribute(new Float32Array(mesh.width), 3));
  geometry.setAttribute('color', new THREE.BufferAttribute(new Float32Array(mesh.width).fill(1), 3));
  geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(mesh.faces), 1));
  const drawn = new THREE.Mesh(geometry, material);
  drawn.frustumCulled = false;
  return drawn;
}

/** Everything of one rollout that is drawn. */
async function actor(rollout, first) {
  const cloth = await unpackMesh(rollout.cloth);
  const body = rollout.body ? await unpackMesh(rollout.body) : first.body;
  const made = { rollout, cloth, body, lost: new Set(rollout.lost), group: new THREE.Group() };
  made.strain = await unpackBytes(rollout.strain);
  made.fabric = (await unpackBytes(rollout.fabric));
  made.clothMesh = surface(cloth, clothMaterial());
  made.bodyMesh = surface(body, bodyMaterial());
  made.group.add(made.clothMesh, made.bodyMesh);
  return made;
}

/** Colours of the cloth's vertices in a frame, by what the user chose. */
function paint(made, at, frame) {
  const mode = byId('colour').value;
  const count = made.cloth.width / 3;
  const target = made.clothMesh.geometry.attributes.color;
  const start = Math.min(frame, made.cloth.frames - 1) * count;
  const tint = byId('layout').value === 'over' ? OVERLAID[at % OVERLAID.length] : null;
  const colour = new THREE.Color();
  for (let i = 0; i < count; i++) {
    let [r, g, b] = PLAIN;
    if (mode === 'strain') [r, g, b] = content.strain.ramp[made.strain[start + i]].map((value) => value / 255);
    else if (tint) [r, g, b] = tint;
    else if (mode === 'fabric') [r, g, b] = [0, 1, 2].map((c) => made.fabric[3 * i + c] / 255);
    colour.setRGB(r, g, b, THREE.SRGBColorSpace);
    target.setXYZ(i, colour.r, colour.g, colour.b);
  }
  target.needsUpdate = true;
}

function pose(drawn, mesh, frame) {
  const positions = drawn.geometry.attributes.position;
  positionsAt(mesh, frame, positions.array);
  positions.needsUpdate = true;
  drawn.geometry.computeVertexNormals();
}

const renderer = new THREE.WebGLRenderer({ canvas: byId('canvas'), antialias: true, preserveDrawingBuffer: true });
const scene = new THREE.Scene();
scene.background = new THREE.Color(0xf1f2f4);
const camera = new THREE.PerspectiveCamera(35, 1, 0.02, 200);
const controls = new OrbitControls(camera, byId('canvas'));
const lamp = new THREE.DirectionalLight(0xffffff, 2.0);
scene.add(new THREE.HemisphereLight(0xffffff, 0xb0a8a0, 1.6), lamp, lamp.target);
let actors = [];
let frames = 1;

/** Lay the scene out for a frame; the camera goes along with the body where it is to follow. */
function show(frame, moveCamera = true) {
  const before = actors[0].centres[state.frame];
  state.frame = frame;
  actors.forEach((made, at) => {
    pose(made.clothMesh, made.cloth, frame);
    pose(made.bodyMesh, made.body, frame);
    paint(made, at, frame);
  });
  if (moveCamera && byId('follow').checked) {
    const shift = new THREE.Vector3(...actors[0].centres[frame]).sub(new THREE.Vector3(...before));
    camera.position.add(shift);
    controls.target.add(shift);
  }
  byId('time').value = frame;
  byId('frame').textContent = `frame ${frame} of ${frames - 1}, ${(frame * content.seconds).toFixed(2)} s`;
  const lost = actors.filter((made) => made.lost.has(frame)).map((made) => made.rollout.name);
  byId('said').textContent = lost.length ? `${lost.join(', ')}: no finite positions in this frame` : '';
  drawChart(byId('chart'), content.rollouts, byId('figure').value, frame, frames);
}

/** One picture: a part of the canvas for every rollout, or all of them in one. */
function draw() {
  const { clientWidth: width, clientHeight: height } = byId('stage');
  const beside = byId('layout').value === 'beside';
  const parts = beside ? actors.map((made) => [made]) : [actors];
  camera.aspect = width / parts.length / height;
  camera.updateProjectionMatrix();
  lamp.position.copy(camera.position).add(new THREE.Vector3(1, 2.5, 0.5));
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
  renderer.setPixelRatio(window.devicePixelRatio);
  renderer.setSize(byId('stage').clientWidth, byId('stage').clientHeight, false);
  drawChart(byId('chart'), content.rollouts, byId('figure').value, state.frame, frames);
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
  const strain = byId('colour').value === 'strain';
  const colours = content.strain.ramp.filter((_, at) => at % 15 === 0).map((rgb) => `rgb(${rgb})`);
  byId('scale').style.display = strain ? 'block' : 'none';
  byId('scale').innerHTML = `<i></i>strain 0 to ${+(100 * content.strain.high).toPrecision(3)}%`;
  byId('scale').firstChild.style.background = `linear-gradient(to right, ${colours})`;
  const beside = byId('layout').value === 'beside';
  byId('names').replaceChildren(...content.rollouts.map((rollout, at) => {
    const name = document.createElement('span');
    name.textContent = rollout.name;
    if (!beside && OVERLAID[at % OVERLAID.length]) name.style.color = `rgb(${OVERLAID[at % OVERLAID.length].map((v) => 200 * v)})`;
    return name;
  }));
  for (const made of actors) made.clothMesh.material.wireframe = byId('wire').checked;
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

async function start() {
  for (const rollout of content.rollouts) actors.push(await actor(rollout, actors[0]));
  frames = Math.max(...actors.map((made) => made.cloth.frames));
  actors[0].centres = Array.from({ length: frames }, (_, at) => middleAt(guide(), at).middle);
  for (const made of actors) scene.add(made.group);
  byId('time').max = frames - 1;
  byId('two').hidden = actors.length < 2;
  for (const [name, title] of figureNames(content.rollouts)) byId('figure').add(new Option(title, name));
  if (!byId('figure').length) byId('chart').hidden = byId('which').hidden = true;
  const { middle, extent } = middleAt(guide(), 0);
  controls.target.set(...middle);
  camera.position.set(middle[0], middle[1] + 0.15 * extent, middle[2] + 2.0 * extent);
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
