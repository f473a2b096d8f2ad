// The camera: views from fixed sides, one that the user turns, and the parts of the canvas that rollouts are drawn in.
import * as THREE from 'three';
import { OrbitControls } from 'orbit';

const SIDES = { front: [0, 1], side: [1, 0], back: [0, -1] };
/** Width over height that a standing person needs. */
const PERSON = 0.62;
const UP = new THREE.Vector3(0, 1, 0);

/** Columns and rows for `count` pictures of standing people, so that they are drawn as large as can be. */
export function gridOf(count, width, height) {
  let best = { columns: count, rows: 1, size: 0 };
  for (let columns = count; columns >= 1; columns--) {
    const rows = Math.ceil(count / columns);
    const size = Math.min(width / columns / PERSON, height / rows);
    if (size > best.size) best = { columns, rows, size };
  }
  return best;
}

/** Camera and controls over a canvas; `turned` is called once the user turns, moves or zooms. */
export function makeCamera(canvas, extent, turned) {
  const camera = new THREE.PerspectiveCamera(35, 1, 0.02, 200);
  const controls = new OrbitControls(camera, canvas);
  let free = null;
  controls.addEventListener('start', turned);
  controls.addEventListener('end', () => { free = offset(); });
  const offset = () => camera.position.clone().sub(controls.target);
  return {
    camera,
    controls,
    /** Look at `middle` from the front, the side or the back of the first frame, or as the user turned it last. */
    view(name, middle, aspect) {
      controls.target.set(...middle);
      const away = 1.7 * extent * Math.max(1, PERSON / aspect);
      const [x, z] = SIDES[name] ?? [0, 0];
      const from = name === 'free' ? free ?? offset() : new THREE.Vector3(x * away, 0.15 * extent, z * away);
      camera.position.copy(controls.target).add(from);
    },
    /** Go along with what is shown, which moved by `shift`. */
    follow(shift) {
      camera.position.add(shift);
      controls.target.add(shift);
    },
    /** Turn by radians about the vertical and up, and come nearer by a factor, as a finger or the mouse does. */
    turn(right, up, nearer) {
      const ball = new THREE.Spherical().setFromVector3(offset().divideScalar(nearer));
      ball.theta += right;
      ball.phi = Math.min(Math.PI - 0.01, Math.max(0.01, ball.phi - up));
      camera.position.setFromSpherical(ball).add(controls.target);
      camera.up.copy(UP);
      free = offset();
      turned();
    },
  };
}
