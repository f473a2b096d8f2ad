// The chart under the timeline: one figure of every rollout over the frames.

const COLOURS = ['#3b6fb6', '#c9702f', '#4c8452', '#9e476b'];
const MARGIN = { left: 60, right: 12, top: 14, bottom: 6 };

/** Titles of the figures that any rollout has, by their names. */
export function figureNames(rollouts) {
  const found = new Map();
  for (const rollout of rollouts) for (const figure of rollout.figures) found.set(figure.name, figure.title);
  return found;
}

/** Draw the figure `name`, with a line at `frame` of `frames`. */
export function drawChart(canvas, rollouts, name, frame, frames) {
  const pen = prepare(canvas);
  const series = rollouts.map((rollout) => rollout.figures.find((figure) => figure.name === name)?.values ?? []);
  const top = Math.max(1e-12, ...series.flat().filter((value) => value !== null));
  const width = canvas.clientWidth - MARGIN.left - MARGIN.right;
  const height = canvas.clientHeight - MARGIN.top - MARGIN.bottom;
  const x = (at) => MARGIN.left + (width * at) / Math.max(1, frames - 1);
  const y = (value) => MARGIN.top + height * (1 - value / top);
  pen.fillStyle = '#3c3e42';
  pen.font = '11px system-ui, sans-serif';
  pen.textAlign = 'right';
  pen.fillText(shown(name, top), MARGIN.left - 4, MARGIN.top + 4);
  pen.fillText('0', MARGIN.left - 4, MARGIN.top + height);
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

function drawValue(pen, name, title, value, at) {
  pen.textAlign = 'left';
  pen.fillStyle = COLOURS[at % COLOURS.length];
  const text = value === undefined || value === null ? '–' : shown(name, value);
  pen.fillText(`${title}: ${text}`, MARGIN.left + 8 + at * 220, 10);
}

function shown(name, value) {
  return name.startsWith('strain') ? `${(100 * value).toPrecision(3)}%` : value.toPrecision(3);
}
