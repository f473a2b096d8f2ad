// Keys, and what is told of them; the page works without a mouse.

/** Keys and what they do, as the help lists them. */
const KEYS = [
  ['Space', 'play, pause'], ['← →', 'one frame back, on'], ['Home End', 'first frame, last frame'],
  ['1 2 3', 'view from the front, the side, the back'], ['4', 'the view that you turned last'],
  ['Shift + ← → ↑ ↓', 'turn the camera'], ['+ −', 'nearer, farther'], ['?', 'this help'], ['Esc', 'close this help'],
  ['drag, one finger', 'turn'], ['wheel, two fingers', 'nearer, farther, move'],
];
const STEP = Math.PI / 24;

/** Fill the help and let it open. */
export function makeHelp(dialog, button) {
  dialog.querySelector('dl').append(...KEYS.flatMap(([key, words]) => [['dt', key], ['dd', words]]).map(
    ([kind, text]) => Object.assign(document.createElement(kind), { textContent: text })));
  button.onclick = () => dialog.showModal();
}

/** What a key that was pressed on `target` is to do, as one of the `actions`; null where the target itself answers to it. */
function actionOf(event, actions) {
  const { key, shiftKey, target } = event;
  const kind = target.type === 'range' ? 'range' : target.tagName;
  if (['SELECT', 'TEXTAREA'].includes(kind) || target.type === 'number') return null;
  const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[key];
  if (shiftKey && steps) return () => actions.turn(steps[0] * STEP, steps[1] * STEP, 1);
  if (key === ' ') return ['BUTTON', 'SUMMARY', 'INPUT'].includes(kind) ? null : actions.play;
  if (key === 'ArrowLeft' || key === 'ArrowRight') return kind === 'range' ? null : () => actions.step(steps[0]);
  if (key === 'Home' || key === 'End') return kind === 'range' ? null : () => actions.step(key === 'End' ? Infinity : -Infinity);
  const view = ['front', 'side', 'back', 'free'][Number(key) - 1];
  if (view) return () => actions.view(view);
  if (key === '+' || key === '-') return () => actions.turn(0, 0, key === '+' ? 1.1 : 1 / 1.1);
  return key === '?' ? actions.help : null;
}

/** Answer to the keys of the help by `actions`, unless a text field, a list or the open help has them. */
export function listenToKeys(actions, dialog) {
  window.addEventListener('keydown', (event) => {
    if (dialog.open || event.ctrlKey || event.altKey || event.metaKey) return;
    const action = actionOf(event, actions);
    if (action) { action(); event.preventDefault(); }
  });
}
