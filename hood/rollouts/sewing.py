"""Panels sewn around a body: all seams at once, drawn together without weight, then at rest under it; and a verdict on that.

The panels begin where the pattern puts them, in planes before and behind the body, and their seams between these: cloth would
pass through the body there. So the body begins thin, nearly its bones, and grows to its size while the seams draw together.
A coarse mesh is sewn first. The one that was asked for begins where that has come to rest.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from hood.assets.files.said import ProgressLines
from hood.assets.garment.binding import posed_body
from hood.assets.garment.fasteners import ROOM, with_room
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence_edit import arms_down
from hood.assets.pattern.fronts import opened
from hood.assets.pattern.sheet import PatternSheet, carry_over, sheet_of
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Attachments, Obstacle, State, StepInput
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.energies.self_contact import LayerBarrier, LayerFriction
from hood.mesh.penetration.crossing import crossings, self_crossings
from hood.mesh.topology import boundary_loops
from hood.rollouts.sewn import Sewn, bones_of, floor_at, held_limbs, judged, limbs_in, strapless, waist_of
from hood.scene.start import push_out_of_body
from hood.scene.untangle import smooth_out
from hood.solver.newton import NewtonSettings, minimize
from hood.steppers.newton import minimize_held_off

if TYPE_CHECKING:
    from hood.assets.body.body import Body
    from hood.assets.garment.binding import PosedBody
    from hood.assets.material import Material
    from hood.assets.pattern.pattern import Pattern

#: The thin body has one of these shares of the way from its bones to its skin, and grows by so much [m] a step at most.
_GIRTHS, _GROWTH = (0.15, 0.3, 0.45, 0.6), 0.012
#: In the last attempt it grows by so much [m], within a coarse mesh of so many vertices.
_SLOWER, _FINER = 0.006, 1600
#: Ways up and forward [m] that are tried for a start with the fewest triangles through the thin body; farther ones up or down
#: where limbs are in none of the openings with these.
_LIFTS, _DEPTHS = (0.0, 0.03, -0.03, 0.06, 0.1), (0.0, -0.03, 0.03)
_FARTHER = (-0.1, 0.15, -0.15, 0.2, -0.2, 0.25, -0.25, 0.3, -0.3)
#: A step in which a vertex goes farther than twice this [m] is taken again with half the time; steps grow while none does.
_STRIDE = 0.02
#: Steps without weight last from the first to the second [s], those under it to the third; so many at most of each.
_SHORTEST, _DRAWN, _LONGEST, _MOST_DRAWN, _MOST_RESTING = 1e-4, 0.1, 1.0, 120, 40
#: Of the steps without weight, so many at most once the body has grown: what creeps then goes on under weight.
_MOST_GROWN = 10
#: The body grows once steps are so long [s]: before, the seams are open.
_CLOSED = 2e-3
#: At rest the vertices move by less than this [m/s] in the mean, without weight by less than the second.
_REST, _NEARLY = 1e-3, 5e-3
_ROUGH, _FINE = NewtonSettings(target_rg=0.1, max_iterations=15), NewtonSettings(target_rg=1e-2)
#: Cloth that still passes through the body at rest is held so far off [m], one after the other.
_HELD_OFF = (3e-3, 4e-3, 6e-3)
#: Friction while a top without straps is drawn together, which would slide off the chest.
_GRIP = 0.5
#: Friction at rest holds what slips by less than this [m/s].
_SLIP = 2e-4
#: What still does begins again with the body grown by the first of these shares where nothing passes through it, which grows by
#: so much of what it does elsewhere.
_SHRUNK, _AGAIN = (0.8, 0.6, 0.4, 0.3, 0.2, 0.1, 0.0), 0.5
#: Cloth at rest that passes through itself is smoothed there once in so many steps.
_PAUSE = 8
#: The coarse mesh has about so many vertices, with edges from the second to the third [m].
_COARSE, _LEAST_EDGE, _MOST_EDGE = 700, 0.022, 0.05
#: Arms of the poses of the T and the A, degrees below the former.
_TPOSE, _APOSE = 0.0, 45.0
#: Legs of a body that puts on trousers end so far apart, degrees each, or else the second: between thighs that touch there is
#: no room for two seams.
_APART = (5.0, 10.0)
#: Cloth nearer to the floor than the first [m] meets it: panels that reach lower begin within the second, pressed together.
_LOW, _PRESSED = 0.15, 0.06
#: Panels begin no farther before and behind the body [m].
_DEEPEST = 0.25
#: Where more than so many triangles pass through the thin body, starts of these shares of the width are looked at.
_TANGLED, _NARROW = 40, (0.85, 0.7)


@dataclass(frozen=True)
class SewingStart:
    """Where a pattern begins around a body: moved up and forward [m], with the share of the body's girth that it has then.

    Args:
        before: the body as the pattern has it, which becomes ``posed`` as it grows.
        growth: m, that a vertex of the body moves by at most in a step.
        narrow: share of its width that it begins with: sides of wide panels would pass through the arms.
    """

    before: PosedBody
    posed: PosedBody
    lift: float
    depth: float
    thin: float
    growth: float = _GROWTH
    narrow: float = 1.0

    def thin_body(self) -> np.ndarray:
        """(W, 3) m: the skin of the body at the beginning."""
        bones = bones_of(self.before)
        return np.asarray(bones + self.thin * (self.before.surface - bones))

    def placed(self, sheet: PatternSheet) -> np.ndarray:
        """(V, 3) m: the vertices of a pattern; what reaches below the floor or far before and behind the body is pressed
        together."""
        deep = min(1.0, _DEEPEST / max(float(np.abs(sheet.pos[:, 2]).max()), 1e-9))
        pos = sheet.pos * [self.narrow, 1.0, deep] + [0.0, self.lift, self.depth]
        low = np.minimum(pos[:, 1], _PRESSED)
        pos[:, 1] += _PRESSED * np.exp((low - _PRESSED) / _PRESSED) - low
        return np.asarray(pos + [0.0, float(self.before.surface[:, 1].min()), 0.0])


@torch.no_grad()
def sew_pattern(
    pattern: Pattern, sheet: PatternSheet, body: Body, betas: np.ndarray, material: Material, angle: float | None = None
) -> tuple[PosedBody, Sewn]:
    """A pattern, meshed as ``sheet``, sewn around a body: the best of three attempts, which differ in pose and girth.

    Args:
        angle: of the arms below the T-pose, degrees; None: 45 and 0, first that in which more limbs begin in openings of their
            own, else 45 with sleeves and 0 without.

    Examples:
        >>> sheet = sheet_of(pattern, 0.012, "shirt")  # doctest: +SKIP
        >>> posed, sewn = sew_pattern(pattern, sheet, body, np.zeros(10), Material())  # doctest: +SKIP
        >>> sewn.figures.faults  # doctest: +SKIP
        []
    """
    began = time.perf_counter()
    coarse = _coarser(pattern, sheet, _COARSE)
    arms = [angle] if angle is not None else [_APOSE, _TPOSE] if pattern.sleeved else [_TPOSE, _APOSE]
    first = sewing_starts(coarse, _standing(body, betas, arms[0], 0.0))[0]
    if _has_legs(coarse, first):
        ways = [replace(first, posed=_standing(body, betas, arms[0], apart)) for apart in _APART]
    else:
        starts = [first, *(sewing_starts(coarse, _standing(body, betas, other, 0.0))[0] for other in arms[1:])]
        ways = sorted(starts, key=lambda start: _worn(coarse, start), reverse=True)
    ways.append(replace(ways[0], growth=_SLOWER))
    tries = []
    for way in ways:
        mesh = coarse if way is not ways[-1] else _coarser(pattern, sheet, _FINER)
        rough = sew_around(mesh, way.posed, material, start=way)
        tries.append(_Attempt(way, mesh, rough, rough))
        if rough.figures.in_place and not rough.figures.body_crossings:
            tries[-1] = tries[-1].finer(sheet, material)
        if tries[-1].mesh is sheet and not tries[-1].sewn.figures.faults:
            break
    else:  # what a coarse mesh passes through a fine one may not
        for number in sorted(range(len(tries)), key=lambda number: tries[number].rough.figures.rank):
            if tries[number].rough.figures.in_place:
                tries[number] = tries[number].finer(sheet, material)
                if not tries[number].sewn.figures.faults:
                    break
    best = min(tries, key=lambda one: one.sewn.figures.rank).finer(sheet, material)
    return best.start.posed, replace(best.sewn, seconds=time.perf_counter() - began)


@dataclass(frozen=True)
class _Attempt:
    """A garment sewn as the mesh ``mesh``: as the coarse one that was tried, and as it was asked for where it got there."""

    start: SewingStart
    mesh: PatternSheet
    rough: Sewn
    sewn: Sewn

    def finer(self, sheet: PatternSheet, material: Material) -> _Attempt:
        """As the mesh that is asked for; itself where it is."""
        if self.mesh is sheet:
            return self
        return replace(self, mesh=sheet, sewn=sewn_finer(self.mesh, self.rough, sheet, self.start, material))


def _standing(body: Body, betas: np.ndarray, arms: float, legs: float) -> PosedBody:
    """The body with its arms down from the T-pose and each leg turned outwards, in degrees."""
    frame = arms_down(arms)
    poses = frame.poses.copy()
    poses[:, [1, 2], 2] += np.radians([legs, -legs])
    return posed_body(body, replace(frame, poses=poses), 0, betas)


def _has_legs(sheet: PatternSheet, start: SewingStart) -> bool:
    """Whether a leg alone is in an opening."""
    pos = start.placed(sheet)
    return any(limbs_in(pos[loop], start.before) & {"left leg", "right leg"} for loop in boundary_loops(sheet.faces))


def _coarser(pattern: Pattern, sheet: PatternSheet, count: int) -> PatternSheet:
    """A mesh of the pattern of about ``count`` vertices: less than half of those of ``sheet`` or, in the last attempt, more;
    else that itself."""
    area = 0.5 * float(np.abs(np.linalg.det(sheet.flat[:, 1:] - sheet.flat[:, :1])).sum())
    wide = min(max(math.sqrt(area / count / math.sqrt(0.75)), _LEAST_EDGE), _MOST_EDGE)
    while True:
        try:
            coarse = sheet_of(pattern, wide, pattern.name)
        except ValueError:  # a panel is too narrow for such edges
            coarse = None
        if coarse is not None:
            another = 2 * len(coarse.pos) < len(sheet.pos) or (count == _FINER and len(coarse.pos) > len(sheet.pos))
            return coarse if another else sheet
        if area / wide**2 > max(len(sheet.pos), count):
            return sheet
        wide *= 0.8


def sewing_starts(sheet: PatternSheet, posed: PosedBody, girths: Sequence[float] = _GIRTHS) -> list[SewingStart]:
    """Places of the pattern before and behind a body with limbs in as many openings as can be had, that with the fewest
    triangles through the thin body first; and of its girths the greatest with which there are no more."""
    surface, bones = posed.surface, bones_of(posed)
    higher = float(sheet.pos[:, 1].max()) * (float(np.ptp(surface[:, 1])) / sheet.height - 1.0)

    def placed(lifts: Sequence[float], narrow: float = 1.0) -> list[tuple[tuple[int, int], SewingStart]]:
        ways = [(lift + higher, depth) for depth in _DEPTHS for lift in lifts]
        starts = [SewingStart(posed, posed, *way, 0.0, narrow=narrow) for way in ways]
        ranked = [(_worn(sheet, start), start) for start in starts]
        most = max(worn for worn, _ in ranked)
        return [(worn, start) for worn, start in ranked if worn == most]

    places = placed(_LIFTS)
    far = placed(_FARTHER) if places[0][0][1] < 0 else places
    places = far if far[0][0][0] > places[0][0][0] else places

    def crossed(worn: Sequence[tuple[tuple[int, int], SewingStart]], thin: float) -> list[tuple[int, float, SewingStart]]:
        body, found = bones + thin * (surface - bones), []
        for start in (replace(start, thin=thin) for _, start in worn):
            pairs = crossings(start.placed(sheet), sheet.faces, body, posed.faces).pairs
            found.append((len(pairs), abs(start.lift - higher) + abs(start.depth), start))
        return sorted(found, key=lambda one: one[:2])

    thinnest, *others = sorted(girths)
    best = crossed(places, thinnest)
    for narrow in _NARROW:
        if best[0][0] > _TANGLED and (fewer := placed(_LIFTS, narrow))[0][0] >= places[0][0]:
            found = crossed(fewer, thinnest)
            places, best = (fewer, found) if found[0][0] < best[0][0] else (places, best)
    for thin in others:
        found = crossed(places, thin)
        if found[0][0] > best[0][0]:
            break
        best = found
    return [start for _, _, start in best]


def _worn(sheet: PatternSheet, start: SewingStart) -> tuple[int, int]:
    """How many arms and legs begin alone in an opening; and how many openings with nothing in them, below 0."""
    pos = start.placed(sheet)
    limbs = [limbs for _, limbs in held_limbs(sheet.faces, pos, start.before, pos)]
    return len({one for one in limbs if len(one) == 1} - {frozenset({"trunk"})}), -sum(not one for one in limbs)


@torch.no_grad()
def sew_around(
    sheet: PatternSheet, posed: PosedBody, material: Material, held: np.ndarray | None = None, start: SewingStart | None = None
) -> Sewn:
    """One mesh of a pattern sewn around a body that stands still, in one attempt.

    Args:
        sheet: its floor is at y = 0, its middle at x = z = 0.
        posed: the body.
        held: (V,) bool, vertices that are held while the cloth comes to rest; None: the waist of what is worn below it.
        start: None: the best of :func:`sewing_starts`.
    """
    start = start or sewing_starts(sheet, posed)[0]
    work = _Work(sheet, start, material, waist_of(sheet) & ~sheet.gathered if held is None else held)
    here, drawn = work.draw_together(torch.as_tensor(work.begun))
    here, resting, speed = work.rest(here, 1.0 / 60.0)
    return work.sewn(here, drawn + resting, speed)


@torch.no_grad()
def sewn_finer(coarse: PatternSheet, sewn: Sewn, sheet: PatternSheet, start: SewingStart, material: Material) -> Sewn:
    """A garment that was sewn as the mesh ``coarse`` at rest as the mesh ``sheet`` of the same pattern."""
    work = _Work(sheet, start, material, waist_of(sheet) & ~sheet.gathered)
    pos = torch.as_tensor(carry_over(coarse, sewn.pos, sheet))
    pos = push_out_of_body(work.cloth, pos, work.body(1.0, 1.0), 2e-3)
    here, resting, speed = work.rest(pos, 1.0 / 30.0)
    return work.sewn(here, sewn.steps + resting, speed)


@torch.no_grad()
def sewn_open(sheet: PatternSheet, sewn: Sewn, posed: PosedBody, material: Material) -> tuple[PatternSheet, Sewn]:
    """A garment that is opened along what closes it, at rest as that holds it, and its mesh; one without as it is."""
    if not sheet.fastened or sewn.figures.faults:
        return sheet, sewn
    cut, pos, before = opened(sheet, sewn.pos)
    closed, _ = with_room(Garment("open", pos, cut.faces, sewn.held[before]), cut.rims)
    work = _Work(cut, SewingStart(posed, posed, sewn.lift, sewn.depth, 1.0), material, closed.pinned)
    here, resting, speed = work.rest(torch.as_tensor(closed.rest_pos), 1.0 / 30.0)
    ready = work.sewn(here, sewn.steps + resting, speed)
    return cut, replace(ready, seconds=sewn.seconds + ready.seconds)


class _Work:
    """The cloth of a pattern and the body that it is sewn around."""

    def __init__(self, sheet: PatternSheet, start: SewingStart, material: Material, held: np.ndarray) -> None:
        self.began = time.perf_counter()
        self.start, self.sheet, self.faces, self.held = start, sheet, sheet.faces, held
        self.begun, firm = start.placed(sheet), sheet.stiffness
        self.cloth = build_cloth(
            self.begun, sheet.faces, material, stiffness=firm, dtype=torch.float64, flat=sheet.flat, made=sheet.made
        )
        posed = start.posed
        skin, thin, faces = posed.surface, start.thin_body(), posed.faces
        floor = float(skin[:, 1].min())
        if float(sheet.pos[:, 1].min()) + start.lift < _LOW:
            points, squares = floor_at(floor)
            faces = np.concatenate([faces, squares + len(skin)])
            skin, thin = np.concatenate([skin, points]), np.concatenate([thin, points])
        self.skin, self.thin, self.body_faces = (torch.as_tensor(table) for table in (skin, thin, faces))
        pairs = torch.as_tensor(np.concatenate([np.zeros((0, 2), dtype=np.int64), *sheet.rows.values()]))
        room = torch.full((len(pairs),), ROOM, dtype=torch.float64)
        self.fastened = Attachments(pairs, pairs[:, 0] >= 0, room) if len(pairs) else None
        self.progress = ProgressLines("sewing")
        self._growth = start.growth / max(float((self.skin - self.thin).norm(dim=1).max()), 1e-9)

    def sewn(self, pos: Tensor, steps: int, speed: float) -> Sewn:
        """What has come of it."""
        start, at = self.start, pos.numpy()
        figures = judged(self.cloth, self.sheet, start.posed, at, self.begun, self.held, speed, start.before)
        return Sewn(at, self.held, start.lift, start.depth, figures, steps, time.perf_counter() - self.began)

    def body(self, share: float, later: float) -> Obstacle:
        """The body that grows from one share of its way from the thin one to another."""
        now, after = (self.thin + s * (self.skin - self.thin) for s in (share, later))
        scenes = [torch.zeros(len(table), dtype=torch.int64) for table in (now, self.body_faces)]
        return Obstacle(now, after, now, self.body_faces, *scenes)

    def _problem(self, pos: Tensor, dt: float, body: Obstacle, weight: bool) -> StepProblem:
        """One implicit step [s] from rest, with weight and what is held, or without."""
        cloth = replace(self.cloth, pinned=torch.as_tensor(self.held)) if weight else self.cloth
        step = StepInput(dt=pos.new_full((1,), dt), obstacle=body, pin_target=pos, attachments=self.fastened)
        problem = StepProblem(cloth, State(pos, torch.zeros_like(pos), pos.new_zeros(1, 3)), step)
        return problem if weight else replace(problem, gravity=pos.new_zeros(3))

    @staticmethod
    def _resting(distance: float = _HELD_OFF[0]) -> Potential:
        """What cloth rests under, so far off the body [m]: its friction slips in a long step no farther than in a rollout's."""
        return default_potential(collision_epsilon=distance, contact="strict", friction_slip_speed=_SLIP)

    def _smoothed(self, pos: Tensor, share: float = 1.0) -> Tensor:
        """The cloth smoothed where it passes through itself."""
        return smooth_out(self.cloth, self.faces, pos, self.body(share, share), 2e-3)

    def _crosses(self, pos: Tensor) -> bool:
        return bool(len(self_crossings(pos.numpy(), self.faces)))

    def draw_together(self, pos: Tensor) -> tuple[Tensor, int]:
        """The seams closed without weight while the body grows; and the steps that it took."""
        plain = default_potential(friction_coefficient=_GRIP if strapless(self.sheet) else 0.0, contact="strict")
        potential, share, dt, grown = plain, 0.0, 1e-3, 0
        for count in range(1, _MOST_DRAWN + 1):
            closed = dt > _CLOSED
            later = min(1.0, share + self._growth) if closed else share
            if closed and potential is plain:
                if share == 0.0:
                    pos = self._smoothed(pos, share)
                if not self._crosses(pos):
                    potential = plain.with_terms(layers=LayerBarrier())
            now = minimize(potential, self._problem(pos, dt, self.body(share, later), False), pos, _ROUGH)[0]
            moved = (now - pos).norm(dim=1)
            if not math.isfinite(float(moved.max())) or (float(moved.max()) > 2.0 * _STRIDE and dt > 2.0 * _SHORTEST):
                dt *= 0.5
                continue
            pos, share = now, later
            self.progress.tell(f"step {count}, the body has grown by {share:.0%}")
            grown += share >= 1.0
            if grown >= _MOST_GROWN or (grown and dt >= _DRAWN and float(moved.mean()) / dt < _NEARLY):
                break
            dt = min(max(dt * min(max(_STRIDE / max(float(moved.max()), 1e-9), 0.5), 2.0), _SHORTEST), _DRAWN)
        return pos, count

    def rest(self, pos: Tensor, dt: float) -> tuple[Tensor, int, float]:
        """The cloth at rest under its weight, the steps, and the speed [m/s] in the last; the first lasts ``dt`` [s]."""
        plain, body, speed = self._resting(), self.body(1.0, 1.0), math.inf
        potential, settings = plain, _ROUGH
        for count in range(1, _MOST_RESTING + 1):
            if potential is plain:
                pos = self._smoothed(pos) if count % _PAUSE == 1 else pos
                if not self._crosses(pos):
                    potential = plain.with_terms(layers=LayerBarrier(), layer_friction=LayerFriction(0.3))
            longest = dt >= _LONGEST
            settings = _FINE if longest else settings
            now = minimize(potential, self._problem(pos, dt, body, True), pos, settings)[0]
            moved = (now - pos).norm(dim=1)
            if not math.isfinite(float(moved.max())) or (float(moved.max()) > 3.0 * _STRIDE and dt > 1.0 / 240.0):
                dt *= 0.25  # where a fold turns over, rough steps would stand still
                continue
            pos, speed = now, float(moved.mean()) / dt
            self.progress.tell(f"it comes to rest, step {count}, and moves by {1e3 * speed:.1f} mm a second")
            if longest and speed <= _REST:
                break
            dt = min(max(dt * min(max(2.0 * _STRIDE / max(float(moved.max()), 1e-9), 0.5), 2.0), 1.0 / 240.0), _LONGEST)
        problem = potential.prepare(self._problem(pos, _LONGEST, body, True))
        return self._regrown(self._out_of_skin(minimize_held_off(potential, problem, pos, _FINE).pos)), count, speed

    def _through(self, pos: Tensor, share: float = 1.0) -> int:
        """How many triangles pass through the body that has grown by a share."""
        posed = self.start.posed
        skin = self.body(share, share).pos[: len(posed.surface)]
        return len(crossings(pos.numpy(), self.faces, skin.numpy(), posed.faces).pairs)

    def _regrown(self, pos: Tensor) -> Tensor:
        """The cloth after the body has shrunk until nothing passes through it and grown again slowly, as a hand that had grown
        through a sleeve; as it was where that leaves no fewer triangles through the body."""
        count, best = self._through(pos), pos
        share = next((share for share in _SHRUNK if not self._through(pos, share)), None) if count else None
        if share is None:
            return pos
        layers = {} if self._crosses(pos) else {"layers": LayerBarrier()}
        potential = self._resting().with_terms(**layers)
        while share < 1.0:
            later = min(1.0, share + _AGAIN * self._growth)
            pos, share = (
                minimize(potential, self._problem(pos, 1.0 / 60.0, self.body(share, later), False), pos, _FINE)[0],
                later,
            )
        for dt in (_DRAWN, _LONGEST):
            pos = minimize(potential, self._problem(pos, dt, self.body(1.0, 1.0), True), pos, _FINE)[0]
        pos = self._out_of_skin(pos)
        return pos if self._through(pos) < count else best

    def _out_of_skin(self, pos: Tensor) -> Tensor:
        """The cloth held farther off the body where triangles still pass through each other."""
        posed, body = self.start.posed, self.body(1.0, 1.0)
        layers = {} if self._crosses(pos) else {"layers": LayerBarrier()}
        for distance in _HELD_OFF:
            if not len(crossings(pos.numpy(), self.faces, posed.surface, posed.faces).pairs):
                break
            potential = self._resting(distance).with_terms(**layers)
            pos = minimize(potential, self._problem(pos, _DRAWN, body, True), pos, _FINE)[0]
        return pos
