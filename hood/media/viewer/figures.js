// The chart under the timeline: one figure of every rollout over the frames.

const COLOURS = ['#3b6fb6', '#c9702f', '#4c8452', '#9e476b'];
const MARGIN = { left: 60, right: 12, top: 14, bottom: 6 };
const GAP = 4; // pixels between two labels

/** Titles of the figures that any rollout has, by their names. */
export function figureNames(rollouts) {
  const found = new Map();
  for (const rollout of rollouts) for (const figure of rollout.figures) found.set(figure.name, figure.title);
  return found;
}

/** Pixels from the left side of a chart `width` pixels wide to a frame. */
export function placeOf(width, frame, frames) {
  return MARGIN.left + ((width - MARGIN.left - MARGIN.right) * frame) / Math.max(1, frames - 1);
}

/** The row of every label, so that none covers another, from their left sides and widths [pixels]. */
export function rowsOf(lefts, widths) {
  const ends = [];
  return lefts.map((left, at) => {
    const free = ends.findIndex((end) => end <= left);
    const row = free < 0 ? ends.length : free;
    ends[row] = left + widths[at] + GAP;
    return row;
  });
}

/** Draw the figure `name`, with a line at `frame` of `frames` and broken ones at the `moments` of events. */
export function drawChart(canvas, rollouts, name, frame, frames, moments = []) {
  const pen = prepare(canvas);
  const series = rollouts.map((rollout) => rollout.figures.find((figure) => figure.name === name)?.values ?? []);
  const top = Math.max(1e-12, ...series.flat().filter((value) => value !== null));
  const height = canvas.clientHeight - MARGIN.top - MARGIN.bottom;
  const x = (at) => placeOf(canvas.clientWidth, at, frames);
  const y = (value) => MARGIN.top + height * (1 - value / top);
  pen.fillStyle = '#3c3e42';
  pen.font = '11px system-ui, sans-serif';
  pen.textAlign = 'right';
  pen.fillText(shown(name, top), MARGIN.left - 4, MARGIN.top + 4);
  pen.fillText('0', MARGIN.left - 4, MARGIN.top + height);
  for (const moment of moments) drawMoment(pen, x(moment.frame), height);
  series.forEach((values, at) => drawLine(pen, values, x, y, COLOURS[at % COLOURS.length]));
  pen.fillStyle = '#0006';
  pen.fillRect(x(frame), MARGIN.top, 1.5, height);
  series.forEach((values, at) => drawValue(pen, name, rollouts[at].name, values[frame], at));
}

/** The frame under a place of the chart, which is `offset` pixels from its left side. */
export function frameUnder(canvas, offset, frames) {
  const share = (offset - MARGIN.left) / (canvas.clientWidth - MARGIN.left - MARGIN.right);
  return Math.round(Math.min(1, Math.max(0, share)) * (frames - 1));
}

function prepare(canvas) {
  const ratio = window.devicePixelRatio;
  canvas.width = canvas.clientWidth * ratio;
  canvas.height = canvas.clientHeight * ratio;
  const pen = canvas.getContext('2d');
  pen.scale(ratio, ratio);
  return pen;
}

function drawLine(pen, values, x, y, colour) {
  pen.strokeStyle = colour;
  pen.lineWidth = 1.5;
  pen.beginPath();
  let open = false;
  values.forEach((value, at) => {
    if (value !== null) pen[open ? 'lineTo' : 'moveTo'](x(at), y(value));
    open = value !== null;
  });
  pen.stroke();
}

function drawMoment(pen, x, height) {
  pen.strokeStyle = '#7a4fa3';
  pen.lineWidth = 1;
  pen.setLineDash([3, 3]);
  pen.beginPath();
  pen.moveTo(x, MARGIN.top);
  pen.lineTo(x, MARGIN.top + height);
  pen.stroke();
  pen.setLineDash([]);
}

function drawValue(pen, name, title, value, at) {
  pen.textAlign = 'left';
  pen.fillStyle = COLOURS[at % COLOURS.length];
  const text = value === undefined || value === null ? '–' : shown(name, value);
  pen.fillText(`${title}: ${text}`, MARGIN.left + 8 + at * 220, 10);
}

function shown(name, value) {
  return name.startsWith('strain') ? `${(100 * value).toPrecision(3)}%` : value.toPrecision(3);
}
