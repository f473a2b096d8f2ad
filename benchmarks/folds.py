"""The folds of one garment in several fabrics: how many, how high and how wide, on several meshes of the same pattern.

    python benchmarks/folds.py circle --vertices 4000 --output outputs/folds
    python benchmarks/folds.py circle --vertices 12000 --fabrics silk_habotai denim_12oz --output outputs/folds
    python benchmarks/folds.py shirt --vertices 4000 --words material.woven=true --output outputs/folds_woven

The design is sewn in the default fabric with edges of three lengths, 1.5% apart, which gives meshes that have no vertex in
common. Each is worn in each fabric by a body that turns by 120° in 0.7 s and then stands still for a second. What is printed
are means over the last ten frames, and their spread (standard deviation) over the meshes:

folds       maxima of the distance of the hem from its centre, in the horizontal, that are 10 mm higher than what is beside them
height      of these folds: √2 times the root mean square of that distance without its three longest waves [mm]
radius      of the hem, on average [mm]
wavelength  mean of the spectrum of the curvature of the hem, weighted by its power [mm]
curvature   root mean square of the mean curvature of the cloth, in waves of 60 to 400 mm [1/m]
width       mean wavelength of that curvature over the cloth [mm]

Rollouts that are there are not run again. ``t`` compares neighbours in the order of the fabrics: the difference of the means
over its standard error; beyond ±2.8 it is more than noise (Student, 4 degrees of freedom, 5%).
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.signal import find_peaks
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

import hood
from hood.assets.motion.sequence import PoseSequence
from hood.mesh.topology import boundary_loops
from hood.rollouts.file.reader import read_rollout

#: Area of the pattern over 0.87 [m²], by which a number of vertices becomes a length of edges; and of the meshes a factor each.
SIZES, PHASES = {"circle": 1.62, "shirt": 1.12}, (0.985, 1.0, 1.015)
FABRICS = ("silk_habotai", "wool_suiting", "denim_12oz")
#: Seconds of the turn and of standing, its angle [degrees], frames per second, and the last frames that are measured.
TURN, STILL, ANGLE, FPS, LAST = 0.7, 1.0, 120.0, 30.0, 10
#: Waves of the whole hem that are not folds; mm that a fold is higher than what is beside it; samples of a hem.
WHOLE, PROMINENCE, SAMPLES = 3, 10.0, 512
#: Shortest and longest waves [m] that are measured of curvatures: edges of 4,000 vertices carry the former.
SHORT, LONG = 0.06, 0.4
FIGURES = ("folds", "height", "radius", "wavelength", "curvature", "width")


def turn(folder: Path) -> Path:
    """The motion, as a file: somebody stands as at the start of ``twists``, turns and stands again."""
    path = folder / "turn.npz"
    if not path.exists():
        stand: PoseSequence = hood.load_sequence("twists", FPS).window(0, 1)
        time = np.arange(round((TURN + STILL) * FPS) + 1) / FPS
        share = np.clip(time / TURN, 0.0, 1.0)
        angles = math.radians(ANGLE) * (share - np.sin(2.0 * math.pi * share) / (2.0 * math.pi))
        poses = np.zeros((len(time), 52, 3))
        poses[:, :22] = stand.poses[:, :22]
        poses[:, 0] = (
            Rotation.from_rotvec(angles[:, None] * [0.0, 1.0, 0.0]) * Rotation.from_rotvec(stand.poses[0, 0])
        ).as_rotvec()
        np.savez(
            path, poses=poses.reshape(len(time), -1), trans=np.repeat(stand.transl, len(time), axis=0), betas=np.zeros(10),
            gender="neutral", mocap_framerate=FPS,
        )  # fmt: skip
    return path


def call(*words: object) -> None:
    """A command of ``hood``, silent unless it fails; results that are not sound stay results."""
    command = [sys.executable, "-c", "from hood.cli.main import entry; entry()", *map(str, words)]
    ended = subprocess.run(command, capture_output=True, text=True)
    if ended.returncode not in (0, 3):
        raise SystemExit(f"{' '.join(map(str, words))}: {ended.stderr}")


def worn(design: str, vertices: int, phase: float, fabric: str, words: Sequence[str], folder: Path, frames: int | None) -> Path:
    """The rollout of a garment in a fabric; run where it is not there."""
    folder.mkdir(parents=True, exist_ok=True)
    mesh = f"{design}_{vertices}_{PHASES.index(phase)}"
    garment, path = folder / f"{mesh}.npz", folder / f"{mesh}_{fabric}"
    if not garment.exists():
        edge = phase * math.sqrt(SIZES[design] / vertices)
        call("sew", f"design:{design}", f"edge={edge:.5f}", f"output={garment}", "sheet=none")
    if not (path / "summary.json").exists():
        length = [] if frames is None else [f"num_frames={frames}"]
        call(
            "rollout", f"garment={garment}", f"sequence={turn(folder)}", "up=y", "stepper=newton", f"material={fabric}",
            "video=none", "sheet=false", "fail_on=nothing", f"output={path}", *length, *words,
        )  # fmt: skip
    return path


def hem_figures(pos: np.ndarray, hem: np.ndarray) -> tuple[float, float, float, float]:
    """Folds, height [mm], radius [mm] and wavelength [mm] of positions (V, 3) m and a hem (L,), which is closed."""
    curve = pos[hem][:, [0, 2]]
    steps = np.linalg.norm(np.diff(pos[[*hem, hem[0]]], axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.arange(SAMPLES) / SAMPLES * along[-1]
    x, z = (np.interp(at, along, np.append(row, row[0])) for row in curve.T)
    distance = 1000.0 * np.hypot(x - x.mean(), z - z.mean())
    spectrum = np.fft.rfft(distance)
    spectrum[:WHOLE] = 0.0
    offset = np.fft.irfft(spectrum, SAMPLES)
    start = int(offset.argmin())
    peaks, _ = find_peaks(np.append(np.roll(offset, -start), offset[start]), prominence=PROMINENCE)
    wave = np.fft.fft(x + 1j * z)
    number = np.abs(np.fft.fftfreq(SAMPLES, 1.0 / SAMPLES))
    power = np.abs(wave * number**2) ** 2
    power[(number < WHOLE) | (number > along[-1] / SHORT)] = 0.0
    wavelength = 1000.0 * along[-1] * power.sum() / (number * power).sum()
    return float(len(peaks)), math.sqrt(2.0) * float(offset.std()), float(distance.mean()), float(wavelength)


class Surface:
    """Mean curvature on a mesh at rest, in waves of :data:`SHORT` to :data:`LONG`."""

    def __init__(self, rest: np.ndarray, faces: np.ndarray) -> None:
        corners = rest[faces]
        count, rows, columns, values = len(rest), [], [], []
        area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        for tip in range(3):
            first, second = (tip + 1) % 3, (tip + 2) % 3
            one, two = corners[:, first] - corners[:, tip], corners[:, second] - corners[:, tip]
            half = 0.5 * (one * two).sum(axis=1) / (2.0 * area)
            for row, column, sign in ((first, second, -1), (second, first, -1), (first, first, 1), (second, second, 1)):
                rows.append(faces[:, row])
                columns.append(faces[:, column])
                values.append(sign * half)
        stiffness = coo_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), (count, count))
        self.stiffness, self.mass = stiffness.tocsc(), np.zeros(count)
        np.add.at(self.mass, faces.reshape(-1), np.repeat(area / 3.0, 3))
        self.inside = np.ones(count, dtype=bool)
        for loop in boundary_loops(faces):
            self.inside[loop] = False
        self.filters = [
            splu((diags(self.mass) + (wave / 2.0 / math.pi) ** 2 * self.stiffness).tocsc()) for wave in (SHORT, LONG)
        ]
        self.faces = faces

    def figures(self, pos: np.ndarray) -> tuple[float, float]:
        """Curvature [1/m] and its mean wavelength [mm]."""
        corners = pos[self.faces]
        normal = np.zeros_like(pos)
        np.add.at(normal, self.faces, np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, None])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-30
        force = np.where(self.inside, 0.5 * ((self.stiffness @ pos) * normal).sum(axis=1), 0.0)  # H times the area
        curvature = self.filters[0].solve(force) - self.filters[1].solve(force)
        square, steep = (self.mass * curvature**2).sum(), curvature @ (self.stiffness @ curvature)
        return math.sqrt(square / self.mass.sum()), 1000.0 * 2.0 * math.pi * math.sqrt(square / steep)


def figures(path: Path) -> np.ndarray:
    """(6,) :data:`FIGURES` of a rollout."""
    data = read_rollout(path / "rollout.h5")
    loops = boundary_loops(data.cloth_faces)
    hem = max(loops, key=lambda loop: np.linalg.norm(np.diff(data.rest_pos[loop], axis=0), axis=1).sum())
    surface = Surface(data.rest_pos, data.cloth_faces)
    return np.mean([(*hem_figures(pos, hem), *surface.figures(pos)) for pos in data.cloth_pos[-LAST:]], axis=0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("design", choices=list(SIZES))
    parser.add_argument("--vertices", type=int, default=4000)
    parser.add_argument("--fabrics", nargs="+", default=list(FABRICS), help="from the limpest to the stiffest")
    parser.add_argument("--meshes", type=int, default=len(PHASES), help="how many of the three lengths of edges")
    parser.add_argument("--frames", type=int, help="fewer frames than the motion has")
    parser.add_argument("--words", nargs="+", default=[], help="further words of hood rollout, such as wind=0")
    parser.add_argument("--output", type=Path, default=Path("outputs/folds"))
    chosen = parser.parse_args()
    table: dict[str, np.ndarray] = {}
    for fabric in chosen.fabrics:
        rows = []
        for phase in PHASES[: chosen.meshes]:
            path = worn(chosen.design, chosen.vertices, phase, fabric, chosen.words, chosen.output, chosen.frames)
            rows.append(figures(path))
        table[fabric] = np.array(rows)
    print(f"{chosen.design + ' ' + str(chosen.vertices):16}" + "".join(f"{name:>18}" for name in FIGURES))
    for fabric, values in table.items():
        spread = values.std(axis=0, ddof=1) if len(values) > 1 else np.zeros(values.shape[1])
        cells = zip(values.mean(axis=0), spread, strict=True)
        print(f"{fabric:16}" + "".join(f"{mean:11.1f} ±{more:5.1f}" for mean, more in cells))
    for one, two in zip(chosen.fabrics[:-1], chosen.fabrics[1:], strict=True) if chosen.meshes > 1 else ():
        error = np.sqrt((table[one].var(axis=0, ddof=1) + table[two].var(axis=0, ddof=1)) / chosen.meshes + 1e-12)
        print(f"{'t':16}" + "".join(f"{t:18.1f}" for t in (table[two].mean(axis=0) - table[one].mean(axis=0)) / error))


if __name__ == "__main__":
    main()
