// Marks of the time line: events, alarms of the guard, and frames that the verdict names.
import { placeOf, rowsOf } from 'figures';

/** Sign, so that kinds are not told apart by colour alone, and colour of a mark by its kind; style classes have their names. */
export const KINDS = { event: ['◆', '#6d4494'], alarm: ['▲', '#8a5200'], unsound: ['✖', '#a31d1d'], doubt: ['?', '#2b5c9e'] };
const ROW = 26; // pixels from one row of labels to the next

/** Frames and seconds of a mark in words. */
function whenOf({ frame, last }, seconds) {
  const frames = last > frame ? `frames ${frame}–${last}` : `frame ${frame}`;
  return `${frames}, ${(frame * seconds).toFixed(2)} s`;
}

/** A button that leads to the first frame of a mark, with its words. */
function buttonOf(mark, seconds, go, whole) {
  const button = document.createElement('button');
  const words = whole && mark.title ? `${mark.words}. ${mark.title}` : mark.words;
  const name = document.createElement('span');
  name.textContent = whole ? `${whenOf(mark, seconds)}: ${words}` : words;
  const sign = Object.assign(document.createElement('i'), { textContent: KINDS[mark.kind][0] });
  sign.ariaHidden = 'true';
  button.type = 'button';
  button.className = mark.kind;
  button.title = `${mark.title || mark.words} (${whenOf(mark, seconds)})`;
  if (!whole) button.ariaLabel = `${mark.kind}: ${mark.words}, ${whenOf(mark, seconds)}`;
  button.append(sign, name);
  button.onclick = () => go(mark.frame);
  return button;
}

/** Buttons of all marks in `strip`, and as a list with whole sentences in `list`. */
export function fillMarks(strip, list, marks, seconds, go) {
  strip.append(...marks.map((mark) => buttonOf(mark, seconds, go, false)));
  list.append(...marks.map((mark) => {
    const item = document.createElement('li');
    item.append(buttonOf(mark, seconds, go, true));
    return item;
  }));
}

/** Put the buttons above their places in the chart, in as few rows as they need. */
export function layMarks(strip, marks, frames) {
  const wide = strip.clientWidth;
  const buttons = [...strip.children];
  const widths = buttons.map((button) => button.offsetWidth);
  const lefts = widths.map((width, at) => Math.max(0, Math.min(placeOf(wide, marks[at].frame, frames), wide - width)));
  const rows = rowsOf(lefts, widths);
  buttons.forEach((button, at) => {
    button.style.left = `${lefts[at]}px`;
    button.style.top = `${ROW * rows[at]}px`;
  });
  strip.style.height = `${ROW * (1 + Math.max(-1, ...rows))}px`;
}
