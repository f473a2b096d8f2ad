// The chart under the timeline: one figure of every rollout over the frames.

import { INKS } from 'colours';

const MARGIN = { left: 60, right: 12, top: 8, bottom: 6 };
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

/** Draw the figure `name`, with a line at `frame` of `frames` and broken ones at the `moments`, in the colours of their kinds. */
export function drawChart(canvas, rollouts, name, frame, frames, moments, kinds) {
  const pen = prepare(canvas);
  const series = rollouts.map((rollout) => figureOf(rollout, name));
  const top = Math.max(1e-12, ...series.flat().filter((value) => value !== null));
  const height = canvas.clientHeight - MARGIN.top - MARGIN.bottom;
  const x = (at) => placeOf(canvas.clientWidth, at, frames);
  const y = (value) => MARGIN.top + height * (1 - value / top);
  pen.fillStyle = '#3c3e42';
  pen.font = '11px system-ui, sans-serif';
  pen.textAlign = 'right';
  pen.fillText(shown(name, top), MARGIN.left - 4, MARGIN.top + 4);
  pen.fillText('0', MARGIN.left - 4, MARGIN.top + height);
  for (const moment of moments) drawMoment(pen, x(moment.frame), x(moment.last), height, kinds[moment.kind][1]);
  series.forEach((values, at) => drawLine(pen, values, x, y, INKS[at % INKS.length]));
  pen.fillStyle = '#0006';
  pen.fillRect(x(frame), MARGIN.top, 1.5, height);
}

const figureOf = (rollout, name) => rollout.figures.find((figure) => figure.name === name)?.values ?? [];

/** The values of a frame in the colours of their lines, as the children of `legend`. */
export function tellValues(legend, rollouts, name, frame) {
  if (legend.children.length !== rollouts.length) {
    legend.replaceChildren(...rollouts.map((_, at) => {
      const line = document.createElement('span');
      line.style.color = INKS[at % INKS.length];
      return line;
    }));
  }
  rollouts.forEach((rollout, at) => {
    const value = figureOf(rollout, name)[frame] ?? null;
    legend.children[at].textContent = `${rollout.name}: ${value === null ? '–' : shown(name, value)}`;
  });
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

function drawMoment(pen, first, last, height, colour) {
  pen.fillStyle = `${colour}22`;
  pen.fillRect(first, MARGIN.top, last - first, height);
  pen.strokeStyle = colour;
  pen.lineWidth = 1;
  pen.setLineDash([3, 3]);
  pen.beginPath();
  pen.moveTo(first, MARGIN.top);
  pen.lineTo(first, MARGIN.top + height);
  pen.stroke();
  pen.setLineDash([]);
}

function shown(name, value) {
  return name.startsWith('strain') ? `${(100 * value).toPrecision(3)}%` : value.toPrecision(3);
}
