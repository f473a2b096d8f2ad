// Draws the rollouts of the page, lets the user turn and play them, and keeps the chart in step.
import * as THREE from 'three';
import { middleAt } from 'data';
import { drawChart, figureNames, frameUnder, tellValues } from 'figures';
import { INKS, OVERLAID, PLAIN, differenceCodes, differenceScale, endsOf, gradientOf, isSameMesh, tableOf, written, wrongEnds } from 'colours';
import { dye, hide, linear, loadImage, makeActor, makeScene, paint, pose } from 'scene';
import { gridOf, makeCamera } from 'camera';
import { KINDS, fillMarks, layMarks } from 'marks';
import { listenToKeys, makeHelp } from 'controls';

const byId = (id) => document.getElementById(id);
const state = { frame: 0, view: 'front', playing: false, since: 0, table: null, hidden: new Set(), telling: 0 };
const plain = linear(PLAIN);
let content, ramp, renderer, scene, lamp, floor, eye;
let actors = [];
let frames = 1;

/** The page's data; an error names what is missing. */
function readContent() {
  const read = JSON.parse(byId('content').textContent);
  const need = (table, keys, where) => keys.forEach((key) => {
    if (table[key] === undefined) throw new Error(`its data lack '${where}${key}'; write it again with hood view`);
  });
  need(read, ['images', 'seconds', 'moments', 'floor', 'ramp', 'scales', 'rollouts'], '');
  read.rollouts.forEach((rollout, at) => need(
    rollout, ['name', 'cloth', 'lost', 'values', 'fabric', 'body', 'figures', 'parts', 'mapped'], `rollouts[${at}].`));
  return read;
}

/** The renderer; an error says what a browser without WebGL needs. */
function makeRenderer() {
  try {
    return new THREE.WebGLRenderer({ canvas: byId('canvas'), antialias: true, preserveDrawingBuffer: true });
  } catch {
    throw new Error('this browser offers no WebGL; switch on hardware acceleration in its settings, or open the page in another browser');
  }
}

/** Whether several rollouts are drawn in one picture. */
const isOver = () => byId('layout').value === 'over' && actors.length > 1;
const scaleNow = () => content.scales.find((one) => one.name === byId('colour').value);

/** Lay the scene out for a frame; the camera goes along with the body where it is to follow. */
function show(frame, moveCamera = true) {
  const before = actors[0].centres[state.frame];
  const scale = scaleNow();
  state.frame = frame;
  for (const made of actors) {
    pose(made.clothMesh, made.cloth, frame, made.mapped, made.vertices);
    pose(made.bodyMesh, made.body, frame);
    if (scale?.name === 'difference' && made.apart) {
      paint(made, differenceCodes(actors[0].cloth, made.cloth, frame, scale, made.apart), 0, state.table);
    } else if (scale && scale.name !== 'difference') {
      const start = (Math.min(frame, made.cloth.frames - 1) * made.cloth.width) / 3;
      paint(made, made.values[scale.name], start, state.table);
    }
  }
  if (moveCamera && byId('follow').checked) {
    eye.follow(new THREE.Vector3(...actors[0].centres[frame]).sub(new THREE.Vector3(...before)));
  }
  tell(frame);
  chart();
}

/** Say which frame is shown: at once to the eye, and to screen readers once it stands still. */
function tell(frame) {
  const words = `frame ${frame} of ${frames - 1}, ${(frame * content.seconds).toFixed(2)} s`;
  const lost = actors.filter((made) => made.lost.has(frame)).map((made) => made.rollout.name);
  const said = lost.length ? `${lost.join(', ')}: no finite positions in this frame` : '';
  byId('time').value = frame;
  byId('time').setAttribute('aria-valuetext', words);
  byId('frame').textContent = words;
  if (byId('said').textContent !== said) byId('said').textContent = said;
  tellValues(byId('legend'), content.rollouts, byId('figure').value, frame);
  clearTimeout(state.telling);
  if (!state.playing) state.telling = setTimeout(() => { byId('live').textContent = words; }, 400);
}

function chart() {
  drawChart(byId('chart'), content.rollouts, byId('figure').value, state.frame, frames, content.moments, KINDS);
}

const grid = () => gridOf(isOver() ? 1 : actors.length, byId('stage').clientWidth, byId('stage').clientHeight);

/** One picture: a part of the canvas for every rollout, or all of them in one. */
function draw() {
  const { clientWidth: width, clientHeight: height } = byId('stage');
  const { columns, rows } = grid();
  const [wide, high] = [width / columns, height / rows];
  const over = isOver();
  const differ = over && byId('colour').value === 'difference';
  const { camera } = eye;
  camera.aspect = wide / high;
  camera.updateProjectionMatrix();
  lamp.position.set(-0.8, 1, 0.4).applyQuaternion(camera.quaternion).multiplyScalar(3).add(camera.position);
  lamp.target.position.copy(eye.controls.target);
  floor.position.x = eye.controls.target.x;
  floor.position.z = eye.controls.target.z;
  floor.visible = byId('floor').checked;
  renderer.setScissorTest(true);
  (over ? [actors] : actors.map((made) => [made])).forEach((shown, at) => {
    actors.forEach((made, i) => {
      made.group.visible = shown.includes(made);
      made.clothMesh.visible = !made.lost.has(state.frame) && !(differ && i === 0);
      made.bodyMesh.visible = byId('body').checked && (!over || i === 0 || made.body !== actors[0].body);
      const lit = floor.visible && camera.position.y > floor.position.y;
      made.clothShadow.visible = lit && made.clothMesh.visible;
      made.bodyShadow.visible = lit && made.bodyMesh.visible;
    });
    const [left, bottom] = [(at % columns) * wide, (rows - 1 - Math.floor(at / columns)) * high];
    renderer.setViewport(left, bottom, wide, high);
    renderer.setScissor(left, bottom, wide, high);
    renderer.render(scene, camera);
  });
}

function tick(now) {
  const step = (1000 * content.seconds) / Number(byId('speed').value);
  if (state.playing && now - state.since >= step) {
    const steps = Math.floor((now - state.since) / step);
    state.since += step * steps;
    const next = state.frame + steps;
    if (next < frames) show(next);
    else if (byId('loop').checked) show(next % frames);
    else { show(frames - 1); play(false); }
  }
  eye.controls.update();
  draw();
  requestAnimationFrame(tick);
}

function play(on) {
  if (on && state.frame === frames - 1) show(0);
  state.playing = on;
  state.since = performance.now();
  byId('play').textContent = on ? 'pause' : 'play';
  if (!on) tell(state.frame);
}

/** Show a frame that the user chose, within those that there are. */
const go = (frame) => show(Math.min(frames - 1, Math.max(0, frame)));

function look(name) {
  const { columns, rows } = grid();
  const { clientWidth: width, clientHeight: height } = byId('stage');
  eye.view(name, byId('follow').checked ? actors[0].centres[state.frame] : eye.controls.target.toArray(), (width / columns) / (height / rows));
  press(name);
}

function press(name) {
  state.view = name;
  for (const button of byId('views').children) button.setAttribute('aria-pressed', button.dataset.view === name);
}

function resize() {
  layMarks(byId('moments'), content.moments, frames); // its height is part of the page's
  renderer.setPixelRatio(window.devicePixelRatio);
  renderer.setSize(byId('stage').clientWidth, byId('stage').clientHeight, false);
  layNames();
  if (state.view !== 'free') look(state.view); // from as far as the parts of the canvas need
  chart();
}

function layNames() {
  const { columns, rows } = isOver() ? { columns: actors.length, rows: 1 } : grid();
  byId('names').style.gridTemplate = `repeat(${rows}, 1fr) / repeat(${columns}, minmax(0, 1fr))`;
}

/** Save what is seen as a PNG. */
function still() {
  draw();
  const link = document.createElement('a');
  link.download = `${document.title.replace(/[^\w.-]+/g, '_')}_${state.frame}.png`;
  link.href = byId('canvas').toDataURL('image/png');
  link.click();
}

/** Take the colours, the layout and the scale as the user chose them. */
function dress() {
  const over = isOver();
  const colour = byId('colour').value;
  if (!scaleNow() && colour === 'difference') {
    const same = actors.filter((made) => made.apart).map((made) => made.cloth);
    content.scales.push(differenceScale(actors[0].cloth, same));
  }
  const scale = scaleNow();
  byId('ends').disabled = !scale;
  byId('scale').hidden = !scale;
  byId('scale').replaceChildren();
  if (scale) colourBy(scale);
  actors.forEach((made, at) => {
    const tint = over ? linear(OVERLAID[at % OVERLAID.length]) : null;
    const mine = ['fabric', 'texture'].includes(colour) && !over;
    if (!scale || (colour === 'difference' && !made.apart)) dye(made, mine ? null : (!scale && tint) || plain);
    const shown = made.textured && colour === 'texture' && !over ? made.textured : made.coloured;
    made.clothMesh.material = shown;
    for (const material of [shown].flat()) material.wireframe = byId('wire').checked;
  });
  byId('names').replaceChildren(...content.rollouts.map((rollout, at) => {
    const name = document.createElement('span');
    name.textContent = rollout.name;
    if (rollout.note) name.append(Object.assign(document.createElement('small'), { textContent: rollout.note }));
    if (over && !scale) name.style.color = INKS[at % INKS.length];
    return name;
  }));
  show(state.frame, false);
  resize();
}

/** Colours and legend of a scale; where the user's numbers are wrong, it says so and keeps those before. */
function colourBy(scale) {
  const hand = ['low', 'high'].map((id) => byId(id).valueAsNumber);
  const byHand = byId('range').value === 'hand';
  if (!byHand || state.scaled !== scale.name) {
    const ends = endsOf(scale, byHand ? 'page' : byId('range').value, hand);
    ['low', 'high'].forEach((id, at) => { byId(id).value = Number((scale.times * ends[at]).toPrecision(4)); });
    if (state.scaled !== scale.name) byId('limit').value = Number((scale.times * (ends[0] + ends[1]) * 0.5).toPrecision(3));
    state.scaled = scale.name;
  }
  const given = ['low', 'high'].map((id) => byId(id).valueAsNumber);
  const limited = byId('beyond').checked;
  const wrong = wrongEnds(scale, given) || (limited && Number.isNaN(byId('limit').valueAsNumber) ? 'Give a number for the limit.' : '');
  for (const id of ['low', 'high']) byId(id).readOnly = !byHand;
  for (const id of ['low', 'high', 'limit']) byId(id).ariaInvalid = String(Boolean(wrong) && (id !== 'limit') !== wrong.includes('limit'));
  byId('wrong').textContent = wrong;
  if (!wrong || !state.ends) {
    state.ends = wrong ? [scale.low, scale.high] : byHand ? endsOf(scale, 'hand', given) : endsOf(scale, byId('range').value, given);
    state.limit = limited && !wrong ? byId('limit').valueAsNumber / scale.times : null;
  }
  const falls = state.ends[1] < state.ends[0];
  byId('side').textContent = falls ? 'only below' : 'only above';
  document.querySelectorAll('.unit').forEach((unit) => { unit.textContent = scale.unit; });
  state.table = tableOf(scale, state.ends, state.limit, ramp, plain);
  const bar = document.createElement('i');
  bar.style.background = `linear-gradient(to right, ${gradientOf(scale, state.ends, state.limit, content.ramp, PLAIN)})`;
  const beyond = state.limit === null ? '' : `, plain ${falls ? 'above' : 'below'} ${written(scale, state.limit)}`;
  const other = scale.name === 'difference' && actors.some((made) => !made.apart) ? ' (other meshes plain)' : '';
  const text = `${scale.title}: ${written(scale, state.ends[0])} to ${written(scale, state.ends[1])}${beyond}${other}`;
  byId('scale').replaceChildren(bar, Object.assign(document.createElement('b'), { textContent: text }));
}

function listen() {
  byId('play').onclick = () => play(!state.playing);
  byId('time').oninput = () => show(Number(byId('time').value));
  byId('still').onclick = still;
  for (const id of ['colour', 'layout', 'wire', 'figure', 'range', 'low', 'high', 'beyond', 'limit']) byId(id).onchange = dress;
  for (const button of byId('views').children) button.onclick = () => look(button.dataset.view);
  const scrub = (event) => { if (event.buttons) go(frameUnder(byId('chart'), event.offsetX, frames)); };
  byId('chart').onpointermove = scrub;
  byId('chart').onpointerdown = (event) => { byId('chart').setPointerCapture(event.pointerId); scrub(event); };
  byId('canvas').addEventListener('webglcontextlost', () => { byId('said').textContent = 'The browser took the graphics away; load the page again.'; });
  window.onresize = resize;
  new ResizeObserver(resize).observe(byId('stage'));
  makeHelp(byId('help'), byId('keys'));
  listenToKeys({
    play: () => play(!state.playing), step: (by) => go(state.frame + by), view: look, turn: eye.turn,
    help: () => byId('help').showModal(),
  }, byId('help'));
}

/** A box for every part of the cloth that can be hidden; parts of several rollouts with one name share theirs. */
function partBoxes() {
  const names = [...new Set(content.rollouts.flatMap((rollout) => rollout.parts.names))];
  byId('parts').append(...names.map((name) => {
    const box = Object.assign(document.createElement('input'), { type: 'checkbox', checked: true });
    box.dataset.part = name;
    box.onchange = () => {
      state.hidden[box.checked ? 'delete' : 'add'](name);
      for (const made of actors) hide(made, state.hidden);
    };
    const label = document.createElement('label');
    label.append(box, name);
    return label;
  }));
}

/** What the menus offer for these rollouts. */
function fillMenus() {
  byId('two').hidden = actors.length < 2;
  if (content.images.length) {
    byId('colour').add(new Option('texture', 'texture'), 0);
    byId('colour').value = 'texture';
  }
  for (const { name, label } of content.scales) byId('colour').add(new Option(label, name));
  for (const made of actors.slice(1)) if (isSameMesh(actors[0].cloth, made.cloth)) made.apart = new Uint8Array(made.cloth.width / 3);
  if (actors.some((made) => made.apart)) {
    actors[0].apart = new Uint8Array(actors[0].cloth.width / 3);
    byId('colour').add(new Option('difference', 'difference'));
  }
  for (const [name, title] of figureNames(content.rollouts)) byId('figure').add(new Option(title, name));
  if (!byId('figure').length) byId('chart').hidden = byId('which').hidden = byId('legend').hidden = true;
  fillMarks(byId('moments'), byId('list'), content.moments, content.seconds, go);
  byId('told').hidden = byId('moments').hidden = !content.moments.length;
  byId('told').firstElementChild.textContent = `marks (${content.moments.length})`;
  byId('chart').ariaLabel = 'chart of the chosen figure over the frames; its values are told above it';
  byId('settings').open = window.innerWidth > 600;
  if (window.matchMedia('(prefers-reduced-motion: reduce)').matches) byId('loop').checked = false;
  partBoxes();
}

async function start() {
  content = readContent();
  ramp = linear(content.ramp.flat());
  renderer = makeRenderer();
  ({ scene, lamp, floor } = makeScene(content.floor));
  const images = await Promise.all(content.images.map((address) => loadImage(address, renderer)));
  for (const rollout of content.rollouts) actors.push(await makeActor(rollout, actors[0], images, content.floor));
  frames = Math.max(...actors.map((made) => made.cloth.frames));
  const guide = actors[0].body.width ? actors[0].body : actors[0].cloth; // what the camera follows
  actors[0].centres = Array.from({ length: frames }, (_, at) => middleAt(guide, at).middle);
  for (const made of actors) scene.add(made.group);
  byId('time').max = frames - 1;
  eye = makeCamera(byId('canvas'), middleAt(guide, 0).extent, () => press('free'));
  fillMenus();
  listen();
  dress();
  document.body.dataset.ready = 'yes';
  requestAnimationFrame(tick);
}

start().catch((error) => {
  document.body.dataset.ready = 'failed';
  byId('said').textContent = `This page cannot be shown: ${error.message}.`;
  console.error(error);
});
