"""Cloth that hangs from pins which are shaken: what a load does in it travels from the pins on, and nothing else drives it.

A strip of equilateral triangles, held at its upper end, or the dress held by its straps. The body is a stone that stands
still far away, with a joint that moves none of it: pins follow that joint, so that nothing but them tells how they move. It
is shaken by sums of sines whose periods are so and so many *frames*: with another frame rate the ratio of the accelerations
to gravity stays, the way that a load travels in a step does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np

from hood.assets.body.body import Body
from hood.assets.files.atomic import write_atomically
from hood.assets.garment.garment import Garment, load_garment, save_garment
from hood.assets.material import Material
from hood.model.features.physical import GRAVITY

#: Of the strips [m] and [vertices across]: long beside ℓ, so narrow that loads travel along it.
LENGTH, ACROSS = 1.2, 4
#: Vertices of the dress above this share of its height are held: its straps.
STRAPS = 0.94
#: Root mean square of the pins' accelerations [g], upwards and ahead; periods of the sines [frames].
SHAKE, PERIODS, SINES = (0.8, 0.4), (5.0, 20.0), 3
#: The joint that moves the pins, and how far [m] from it they are: it swings them up and down and to and fro.
JOINT, ARM = 1, 2.5
#: The stone: a tetrahedron of this size [m], so far [m] from the cloth, where no contact is in reach.
STONE, AWAY = 0.2, 2.0
TRAINING_MOTIONS, HELD_OUT_MOTIONS, FRAMES = 12, 3, 100


@dataclass(frozen=True)
class Hanging:
    """One member of the family: a cloth, its mean edge [m], and frames per second."""

    cloth: str  # "strip" or "dress"
    edge: float
    fps: int

    @property
    def name(self) -> str:
        return f"{self.cloth}_{1e3 * self.edge:.0f}mm_{self.fps}fps"

    @property
    def title(self) -> str:
        return f"{self.cloth}, {1e3 * self.edge:.0f} mm, {self.fps} fps"

    @property
    def reach(self) -> float:
        """ℓ = c_p dt [m], over which the influence of a load decays in one implicit step of the default fabric."""
        return wave_speed() / self.fps


def wave_speed() -> float:
    """Membrane wave speed [m/s] of the default fabric."""
    cloth = Material()
    stiffness = (cloth.lame_lambda + 2 * cloth.lame_mu) * cloth.thickness  # type: ignore[operator]
    return float(np.sqrt(stiffness / cloth.density))  # type: ignore[operator]


def write_body(path: Path) -> None:
    """The stone as a body file: two joints, the second :data:`ARM` beside the place where cloth hangs."""
    corners = STONE * np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
    joints = np.array([[0.0, 0.0, 0.0], [ARM, 0.0, AWAY]])
    # Joints are affine combinations of the corners, whose mean is the origin.
    regressor = 0.25 + joints @ np.linalg.pinv(corners)
    arrays = {
        "v_template": corners,
        "f": np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]),
        "weights": np.tile([1.0, 0.0], (4, 1)),
        "J_regressor": regressor,
        "kintree_table": np.array([[-1, 0], [0, 1]]),
        "shapedirs": np.zeros((4, 3, 1)),
    }
    _write_arrays(path, arrays)


def make_garment(scene: Hanging, body: Body) -> Garment:
    """The cloth of a scene as it hangs at rest, following the joint of ``body`` where it is held."""
    if scene.cloth == "dress":
        dress = load_garment("dress")
        pos, faces = dress.rest_pos - [0.0, dress.rest_pos[:, 1].max(), 0.0], dress.faces
        pinned = pos[:, 1] > (1 - STRAPS) * pos[:, 1].min()
    else:
        pos, faces, pinned = strip(scene.edge)
    weights = np.zeros((len(pos), body.num_joints))
    weights[:, JOINT] = 1.0
    place = body.shaped(np.zeros(0))[1][JOINT] - [ARM, 0.0, 0.0]
    shapes = np.zeros((len(pos), 3, body.shapedirs.shape[2]))
    return Garment(scene.name, pos + place, faces, pinned, lbs_weights=weights, shapedirs=shapes)


def strip(edge: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions [m], faces and pins of a strip of equilateral triangles that hangs from the origin: edges run along it, so
    that a path of n edges spans n · ``edge`` of its length."""
    down = round(LENGTH / edge) + 1
    column, row = np.meshgrid(np.arange(ACROSS), np.arange(down), indexing="ij")
    x = (column - (ACROSS - 1) / 2) * edge * np.sqrt(0.75)
    pos = np.stack([x, -(row + 0.5 * (column % 2)) * edge, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    number = np.arange(ACROSS * down).reshape(ACROSS, down)
    faces = []
    for left in range(ACROSS - 1):
        for upper in range(down - 1):
            a, b = number[left, upper : upper + 2]
            c, d = number[left + 1, upper : upper + 2]
            # Every second column lies half an edge lower; squares are cut so that all edges are of one length.
            faces += [(a, b, c), (b, d, c)] if left % 2 == 0 else [(a, d, c), (a, b, d)]
    return pos, np.array(faces), row.ravel() == 0


def shaken(seed: int, fps: int) -> np.ndarray:
    """How far (T, 2) [m] up and ahead the pins are: sums of sines with accelerations of :data:`SHAKE`."""
    random = np.random.default_rng(seed)
    periods = random.uniform(*PERIODS, size=(SINES, 2))
    phases = random.uniform(0.0, 2 * np.pi, size=(SINES, 2))
    pulse = 2 * np.pi * fps / periods
    amplitude = np.sqrt(2.0 / SINES) * GRAVITY * np.array(SHAKE) / pulse**2
    time = np.arange(FRAMES)[:, None, None] / fps
    return np.asarray((amplitude * np.sin(pulse * time + phases)).sum(axis=1))


def write_scene(scene: Hanging, body: Body, folder: Path) -> tuple[Path, list[Path], list[Path]]:
    """The garment and the motions as files, as far as they are not there: its path, those to train on and those held out."""
    folder.mkdir(parents=True, exist_ok=True)
    garment = folder / f"{scene.name}.npz"
    if not garment.exists():
        save_garment(garment, make_garment(scene, body))
    paths = [folder / f"shake{seed:02d}_{scene.fps}fps.npz" for seed in range(TRAINING_MOTIONS + HELD_OUT_MOTIONS)]
    for seed, path in enumerate(paths):
        if not path.exists():
            _write_motion(path, shaken(seed, scene.fps), scene.fps)
    return garment, paths[:TRAINING_MOTIONS], paths[TRAINING_MOTIONS:]


def _write_motion(path: Path, places: np.ndarray, fps: int) -> None:
    """The joint's turns that bring what is :data:`ARM` from it to ``places`` (T, 2) [m]."""
    turns = np.zeros((len(places), 23, 3))
    turns[:, JOINT - 1, 2] = -places[:, 0] / ARM
    turns[:, JOINT - 1, 1] = places[:, 1] / ARM
    still = np.zeros((len(places), 3))
    arrays = {"global_orient": still, "body_pose": turns.reshape(-1, 69), "transl": still, "betas": np.zeros(1)}
    _write_arrays(path, arrays | {"fps": np.array(float(fps))})


def _write_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    buffer = BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    write_atomically(path, buffer.getvalue())
