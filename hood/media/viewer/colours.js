// Colours of the cloth: scales, what lies beyond a limit, colours that tell rollouts apart, and how far they are apart.

/** A garment without a colour of its own. */
export const PLAIN = [184, 189, 199];
/** Cloth of rollouts that are drawn over each other, sRGB bytes; told apart also by those who do not tell red from green. */
export const OVERLAID = [[72, 122, 190], [224, 138, 52], [77, 140, 89], [158, 71, 107]];
/** The same for lines and letters on white: contrast of at least 4.5. */
export const INKS = ['#2b5c9e', '#9a4d10', '#356b3c', '#8f3d60'];
const UNKNOWN = 255;

/** The ends of a scale, in the units of its values: those of the page, of all pages, or the user's. */
export function endsOf(scale, choice, hand) {
  if (choice === 'hand') return hand.map((shown) => shown / scale.times);
  return choice === 'fixed' ? scale.fixed : [scale.low, scale.high];
}

/** What is wrong with ends that the user gave; empty if nothing is. */
export function wrongEnds(scale, [low, high]) {
  if (!Number.isFinite(low) || !Number.isFinite(high)) return 'Give a number for both ends of the scale.';
  if (low === high) return 'The two ends of the scale are the same; change one.';
  return scale.logarithmic && (low <= 0 || high <= 0) ? 'This scale is logarithmic: both ends have to be above 0.' : '';
}

/** Whether a value lies on the far side of a limit; on a scale that falls, that is below it. */
export const isBeyond = (value, limit, [low, high]) => (high >= low ? value > limit : value < limit);

/** Colours of all codes, three parts each, from those of the `ramp`; within the `limit` (null: none) they are `plain`. */
export function tableOf(scale, ends, limit, ramp, plain) {
  const table = new Float32Array(3 * (UNKNOWN + 1));
  const measure = scale.logarithmic ? Math.log : (value) => value;
  const [low, high] = ends.map(measure);
  scale.levels.forEach((value, code) => {
    const place = Math.min(1, Math.max(0, (measure(value) - low) / (high - low)));
    const shown = limit === null || isBeyond(value, limit, ends) ? ramp.subarray(3 * Math.round((UNKNOWN - 1) * place)) : plain;
    table.set(shown.subarray(0, 3), 3 * code);
  });
  table.set(ramp.subarray(3 * UNKNOWN, 3 * UNKNOWN + 3), 3 * UNKNOWN);
  return table;
}

/** A value of a scale as text with its unit. */
export const written = (scale, value) => `${Number((scale.times * value).toPrecision(3))}${scale.unit === '%' ? '' : ' '}${scale.unit}`;

/** The colours of a scale from its low end to its high one as those of a CSS gradient; `plain` within the limit. */
export function gradientOf(scale, ends, limit, ramp, plain) {
  const measure = scale.logarithmic ? Math.log : (value) => value;
  const [low, high] = ends.map(measure);
  const edge = limit === null ? 0 : Math.min(1, Math.max(0, (measure(limit) - low) / (high - low))) || 0;
  const stops = ramp.slice(0, -1).filter((_, at) => at % 6 === 0).map((rgb, at, all) => [at / (all.length - 1), `rgb(${rgb})`]);
  const beyond = stops.filter(([place]) => place >= edge).map(([place, colour]) => `${colour} ${100 * place}%`);
  return [...(edge ? [`rgb(${plain}) 0%`, `rgb(${plain}) ${100 * edge}%`] : []), ...beyond, `rgb(${ramp[UNKNOWN - 1]}) 100%`].join(', ');
}

/** Whether two meshes have the same faces, so that the distance of their vertices means something. */
export const isSameMesh = (one, other) => one.width === other.width && one.faces.length === other.faces.length
  && one.faces.every((vertex, at) => vertex === other.faces[at]);

/** Distance [m] of vertex number `at` from where it is in another mesh with the same faces, in a frame. */
function apart(mesh, other, frame, at) {
  const i = Math.min(frame, mesh.frames - 1) * mesh.width + 3 * at;
  const j = Math.min(frame, other.frames - 1) * other.width + 3 * at;
  const x = mesh.whole[i] - other.whole[j], y = mesh.whole[i + 1] - other.whole[j + 1], z = mesh.whole[i + 2] - other.whole[j + 2];
  return mesh.step * Math.sqrt(x * x + y * y + z * z);
}

/** The scale of the distance of meshes from the `first`, over all frames: its high end holds 99.5 % of the values. */
export function differenceScale(first, meshes) {
  const found = [];
  for (const mesh of meshes) {
    const frames = Math.max(first.frames, mesh.frames);
    const stride = Math.max(1, Math.ceil((frames * mesh.width) / 6e5)); // of large meshes not every vertex
    for (let frame = 0; frame < frames; frame++) {
      for (let at = frame % stride; at < mesh.width / 3; at += stride) found.push(apart(first, mesh, frame, at));
    }
  }
  const sorted = Float32Array.from(found).sort();
  const usual = Math.max(sorted[Math.floor(0.995 * (sorted.length - 1))] ?? 0, 1e-3);
  const power = 10 ** Math.floor(Math.log10(usual));
  const high = [1, 2, 5, 10].find((step) => step * power >= usual * (1 - 1e-9)) * power;
  const most = Math.max(high, sorted[sorted.length - 1] ?? 0);
  const levels = Array.from({ length: UNKNOWN }, (_, code) => most * (code / (UNKNOWN - 1)) ** 2);
  return { name: 'difference', label: 'difference', title: 'distance from the first rollout', times: 1e3, unit: 'mm',
    low: 0, high, fixed: [0, 0.02], logarithmic: false, levels };
}

/** Codes of the distances of a mesh's vertices from the `first` in a frame, into `target`. */
export function differenceCodes(first, mesh, frame, scale, target) {
  const most = scale.levels[UNKNOWN - 1];
  for (let at = 0; at < target.length; at++) {
    target[at] = Math.min(UNKNOWN - 1, Math.round((UNKNOWN - 1) * Math.sqrt(apart(first, mesh, frame, at) / most)));
  }
  return target;
}
