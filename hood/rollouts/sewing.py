"""Panels sewn around a body: all seams at once, drawn together without weight, then at rest under it; and a verdict on that.

The panels begin where the pattern puts them, in planes before and behind the body, and their seams between these: cloth would
pass through the body there. So the body begins thin, nearly its bones, and grows to its size while the seams draw together.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from hood.assets.files.said import ProgressLines
from hood.assets.fitting.suspicions import find_openings
from hood.cloth.cloth import Cloth, build_cloth
from hood.cloth.state import Obstacle, State, StepInput
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.energies.self_contact import LayerBarrier, LayerFriction
from hood.mesh.penetration.crossing import crossings, self_crossings
from hood.mesh.topology import boundary_loops
from hood.scene.untangle import smooth_out
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.retry import minimize_held_off

if TYPE_CHECKING:
    from hood.assets.garment.binding import PosedBody
    from hood.assets.material import Material
    from hood.assets.pattern.sheet import PatternSheet

#: The thin body has this share of the way from its bones to its skin, and its skin grows by so much [m] a step at most.
_THIN, _GROWTH = 0.15, 0.006
#: Ways up and forward [m] that are tried for a start with the fewest triangles through the thin body.
_LIFTS, _DEPTHS = (0.0, 0.03, -0.03, 0.06, 0.1), (0.0, -0.03, 0.03)
#: A step in which a vertex goes farther than twice this [m] is taken again with half the time; steps grow while none does.
_STRIDE = 0.02
#: Steps without weight last from the first to the second [s], those under it to the third; so many at most of each.
_SHORTEST, _DRAWN, _LONGEST, _MOST_DRAWN, _MOST_RESTING = 1e-4, 0.1, 1.0, 160, 60
#: Of the steps without weight, so many at most once the body has grown: what creeps then goes on under weight.
_MOST_GROWN = 15
#: The body grows once steps are so long [s]: before, the seams are open.
_CLOSED = 2e-3
#: At rest the vertices move by less than this [m/s] in the mean, without weight by less than the second.
_REST, _NEARLY = 1e-3, 5e-3
_ROUGH, _FINE = NewtonSettings(target_rg=0.1, max_iterations=15), NewtonSettings(target_rg=1e-2)
#: A garment that is sewn well: strain p99 and what its top has sunk by [m] are no more.
STRAIN, SUNK = 0.25, 0.15
#: A garment whose top is below this share of the body's height is held up by its waist.
_WAIST = 0.72


@dataclass(frozen=True)
class SewnFigures:
    """What a sewn garment is judged by.

    Args:
        body_crossings: triangles of cloth and skin that pass through each other, in pairs.
        self_crossings: of cloth and cloth.
        strain_p99: of the lengths of its edges in the pattern.
        empty_openings: with no part of the body in them, of ``openings``.
        sunk: m, of its highest point since it began.
        speed: m/s, the mean in the last step.
    """

    body_crossings: int
    self_crossings: int
    strain_p99: float
    openings: int
    empty_openings: int
    sunk: float
    speed: float

    @property
    def faults(self) -> list[str]:
        """What is wrong with it, in words; none where it is sewn well."""
        limits = (
            (self.body_crossings > 0, f"{self.body_crossings} pairs of triangles pass through the body"),
            (self.self_crossings > 0, f"{self.self_crossings} pairs of its own triangles pass through each other"),
            (not self.strain_p99 <= STRAIN, f"it is stretched by {self.strain_p99:.0%} (p99; {STRAIN:.0%} is allowed)"),
            (self.empty_openings > 0, f"{self.empty_openings} of {self.openings} openings hold no part of the body"),
            (self.sunk > SUNK, f"its top has sunk by {1e2 * self.sunk:.0f} cm"),
            (not self.speed <= 2.0 * _REST, f"it still moves by {1e3 * self.speed:.1f} mm a second"),
        )
        return [text for bad, text in limits if bad]


@dataclass(frozen=True)
class Sewn:
    """A garment where it hangs.

    Args:
        pos: (V, 3) m.
        held: (V,) bool, vertices that were held.
        lift: m up, and ``depth`` m forward, that it was moved by before it began.
        steps: taken.
        seconds: of computing.
    """

    pos: np.ndarray
    held: np.ndarray
    lift: float
    depth: float
    figures: SewnFigures
    steps: int
    seconds: float


@torch.no_grad()
def sew_around(sheet: PatternSheet, posed: PosedBody, material: Material, held: np.ndarray | None = None) -> Sewn:
    """The pattern sewn around a body that stands still.

    Args:
        sheet: its floor is at y = 0, its middle at x = z = 0.
        posed: the body.
        held: (V,) bool, vertices that are held while the cloth comes to rest; None: the waist of what is worn below it.
    """
    began = time.perf_counter()
    floor = float(posed.surface[:, 1].min())
    bones = _bones(posed)
    pos = sheet.pos + [0.0, floor, 0.0]
    thin = bones + _THIN * (posed.surface - bones)
    moves = [np.array([0.0, lift, depth]) for depth in _DEPTHS for lift in _LIFTS]
    move = min(moves, key=lambda way: (len(crossings(pos + way, sheet.faces, thin, posed.faces).pairs), np.abs(way).sum()))
    pos = pos + move
    held = waist_of(sheet, float(np.ptp(posed.surface[:, 1]))) & ~sheet.gathered if held is None else held
    firm = sheet.stiffness
    cloth = build_cloth(pos, sheet.faces, material, stiffness=firm, dtype=torch.float64, flat=sheet.flat, made=sheet.made)
    work = _Work(cloth, sheet.faces, posed, bones)
    here, drawn = work.draw_together(torch.as_tensor(pos))
    top = float(here[:, 1].max())
    here, resting, speed = work.rest(here, torch.as_tensor(held))
    figures = judged(cloth, sheet.faces, posed, here, top, speed)
    return Sewn(here.numpy(), held, float(move[1]), float(move[2]), figures, drawn + resting, time.perf_counter() - began)


def waist_of(sheet: PatternSheet, height: float) -> np.ndarray:
    """(V,) bool: the upper rim of a garment for the lower body: edges that the pattern calls ``lower_interface``, else the
    highest opening where all of the pattern is below the chest of a body of ``height`` [m]. None of other garments."""
    held = np.zeros(len(sheet.pos), dtype=bool)
    if sheet.pos[:, 1].max() > _WAIST * height:
        return held
    rims = boundary_loops(sheet.faces)
    rim = np.zeros_like(held)
    for loop in rims:
        rim[loop] = True
    named = sheet.edge_labels.get("lower_interface")
    if named is not None and (named & rim).any():
        return np.asarray(named & rim)
    if rims:
        held[max(rims, key=lambda loop: float(sheet.pos[loop, 1].mean()))] = True
    return held


def judged(cloth: Cloth, faces: np.ndarray, posed: PosedBody, pos: Tensor, top: float, speed: float) -> SewnFigures:
    """:class:`SewnFigures` of cloth at ``pos`` (V, 3) [m] that began with its highest point at ``top`` [m]."""
    at = pos.numpy()
    if not np.isfinite(at).all():
        return SewnFigures(0, 0, math.inf, 0, 0, math.inf, math.inf)
    start, end = cloth.edges.unbind(dim=1)
    strain = ((pos[end] - pos[start]).norm(dim=1) / cloth.rest_length - 1.0).abs().numpy()
    openings = find_openings(at, faces, posed.surface, posed.faces)
    return SewnFigures(
        len(crossings(at, faces, posed.surface, posed.faces).pairs),
        len(self_crossings(at, faces)),
        float(np.quantile(strain, 0.99)),
        openings.num,
        openings.num_empty,
        top - float(at[:, 1].max()),
        speed,
    )


def _bones(posed: PosedBody) -> np.ndarray:
    """(W, 3) m: for every vertex of the skin the nearest points of the bones that it follows, in their mean by its weights."""
    body, skin = posed.body, posed.surface
    joints = body.shaped(posed.betas)[1]
    joints = np.einsum("jab,jb->ja", posed.transforms[:, :, :3], joints) + posed.transforms[:, :, 3]
    result = np.zeros_like(skin)
    for joint in range(len(joints)):
        rows = np.flatnonzero(body.weights[:, joint] > 0)
        ends = [joints[child] for child, parent in enumerate(body.parents) if parent == joint] or [joints[joint]]
        nearest, least = np.zeros((len(rows), 3)), np.full(len(rows), np.inf)
        for end in ends:
            bone = end - joints[joint]
            share = np.clip((skin[rows] - joints[joint]) @ bone / max(float(bone @ bone), 1e-12), 0.0, 1.0)
            there = joints[joint] + share[:, None] * bone
            distance = np.linalg.norm(skin[rows] - there, axis=1)
            nearer = distance < least
            nearest[nearer], least[nearer] = there[nearer], distance[nearer]
        result[rows] += body.weights[rows, joint, None] * nearest
    return result


class _Work:
    """The cloth of a pattern and the body that it is sewn around."""

    def __init__(self, cloth: Cloth, faces: np.ndarray, posed: PosedBody, bones: np.ndarray) -> None:
        self.cloth, self.faces = cloth, faces
        self.skin, self.bones = torch.as_tensor(posed.surface), torch.as_tensor(bones)
        self.body_faces = torch.as_tensor(posed.faces)
        self.progress = ProgressLines("sewing")
        far = float((self.skin - self.bones).norm(dim=1).max())
        self._growth = _GROWTH / max(far, 1e-9)

    def _body(self, share: float, later: float) -> Obstacle:
        """The body that grows from one share of its way from the bones to another."""
        now, after = (self.bones + s * (self.skin - self.bones) for s in (share, later))
        scenes = [torch.zeros(len(table), dtype=torch.int64) for table in (now, self.body_faces)]
        return Obstacle(now, after, now, self.body_faces, *scenes)

    def _step(
        self, potential: Potential, pos: Tensor, dt: float, body: Obstacle, held: Tensor | None, settings: NewtonSettings
    ) -> Tensor:
        """One implicit step [s] from rest, with weight where something is held or meant to hang."""
        return minimize(potential, self._problem(pos, dt, body, held), pos, settings)[0]

    def _problem(self, pos: Tensor, dt: float, body: Obstacle, held: Tensor | None) -> StepProblem:
        cloth = self.cloth if held is None else replace(self.cloth, pinned=held)
        step = StepInput(dt=pos.new_full((1,), dt), obstacle=body, pin_target=pos)
        problem = StepProblem(cloth, State(pos, torch.zeros_like(pos), pos.new_zeros(1, 3)), step)
        return problem if held is not None else replace(problem, gravity=pos.new_zeros(3))

    def draw_together(self, pos: Tensor) -> tuple[Tensor, int]:
        """The seams closed without weight while the body grows; and the steps that it took."""
        plain = default_potential(friction_coefficient=0.0, contact="strict")
        potential, share, dt, grown = plain, _THIN, 1e-3, 0
        for count in range(1, _MOST_DRAWN + 1):
            later = min(1.0, share + self._growth) if dt > _CLOSED else share
            now = self._step(potential, pos, dt, self._body(share, later), None, _ROUGH)
            moved = (now - pos).norm(dim=1)
            if not math.isfinite(float(moved.max())) or (float(moved.max()) > 2.0 * _STRIDE and dt > 2.0 * _SHORTEST):
                dt *= 0.5
                continue
            pos, share = now, later
            self.progress.tell(f"step {count}, the body has {share:.0%} of its girth")
            grown += share >= 1.0
            if grown >= _MOST_GROWN or (grown and dt >= _DRAWN and float(moved.mean()) / dt < _NEARLY):
                break
            if potential is plain and dt > _CLOSED and not len(self_crossings(pos.numpy(), self.faces)):
                potential = plain.with_terms(layers=LayerBarrier())
            dt = min(max(dt * min(max(_STRIDE / max(float(moved.max()), 1e-9), 0.5), 2.0), _SHORTEST), _DRAWN)
        pos = smooth_out(self.cloth, self.faces, pos, self._body(1.0, 1.0), 2e-3)
        return pos, count

    def rest(self, pos: Tensor, held: Tensor) -> tuple[Tensor, int, float]:
        """The cloth at rest under its weight, the steps, and the speed [m/s] in the last."""
        potential, body, dt, speed = default_potential(contact="strict"), self._body(1.0, 1.0), 1.0 / 60.0, math.inf
        if not len(self_crossings(pos.numpy(), self.faces)):
            potential = potential.with_terms(layers=LayerBarrier(), layer_friction=LayerFriction(0.3))
        for count in range(1, _MOST_RESTING + 1):
            longest = dt >= _LONGEST
            now = self._step(potential, pos, dt, body, held, _FINE if longest else _ROUGH)
            moved = (now - pos).norm(dim=1)
            if not math.isfinite(float(moved.max())) or (float(moved.max()) > 3.0 * _STRIDE and dt > 1.0 / 240.0):
                dt *= 0.5
                continue
            pos, speed = now, float(moved.mean()) / dt
            self.progress.tell(f"it comes to rest, step {count}, and moves by {1e3 * speed:.1f} mm a second")
            if longest and speed <= _REST:
                break
            dt = min(max(dt * min(max(2.0 * _STRIDE / max(float(moved.max()), 1e-9), 0.5), 2.0), 1.0 / 240.0), _LONGEST)
        problem = potential.prepare(self._problem(pos, _LONGEST, body, held))
        return minimize_held_off(potential, problem, pos, _FINE).pos, count, speed
