"""What is measured of a step that was taken: energies, the force left over, and what they are compared with.

On a CPU everything goes through compiled passes and numpy: between two frames a small call of torch costs 30 µs, and there are
a hundred of them. :class:`hood.energies.potential.Potential` is the reference, and computes the energies on an accelerator and
without a compiler.

What is reported about a frame: strain and penetration. Never part of the loss.

Why a minimisation ended, as words in a report and as numbers in a rollout's metrics.
"""

from __future__ import annotations

import weakref
from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.contact.contact import Contact
from hood.energies import compiled_elements
from hood.energies.compiled_elements import absolute_strain
from hood.energies.potential import Potential
from hood.energies.problem import STANDARD_GRAVITY, StepProblem
from hood.energies.term import is_energy
from hood.solver.derivatives import compiled_vertices, vertices

#: A vertex deeper than this [m] inside the body counts as penetrating.
PENETRATION_DEPTH = 2e-3

STRAIN_METRICS = ("strain_p50", "strain_p99", "strain_max")
PENETRATION_METRICS = ("penetration_count", "penetration_share", "penetration_depth")


#: Of a step in which layers of cloth are kept apart: pairs of features within their reach at its end, pairs of faces that were
#: crossed at its start, pairs of features that held vertices drove through each other, 1 where nearly everything is near
#: everything and nothing is kept apart, what it took, and how far held vertices stop short of their targets at most [m], which
#: files from before do not have.
LAYER_METRICS = ("layer_contacts", "layer_crossed", "layer_forced", "layer_overflow", "ms_layers", "pin_lag")


def layer_metrics(problem: StepProblem, next_pos: Tensor) -> dict[str, float]:
    """:data:`LAYER_METRICS` of the step to ``next_pos`` (V, 3); nothing where layers play no role."""
    if not problem.layers:
        return {}
    work = [scene.layers.work for scene in problem.layers]
    pins = [scene.pins for scene in problem.layers if scene.pins is not None]
    near = sum(len(scene.layers.contacts(scene.of(next_pos)).corners) for scene in problem.layers)
    values = (
        near,
        sum(scene.layers.crossed for scene in problem.layers),
        sum(scene.layers.forced for scene in problem.layers),
        any(one.overflowed for one in work),
        1e3 * (sum(one.seconds for one in work) + sum(one.seconds for one in pins)),
        max((one.lag.max(initial=0.0) for one in pins), default=0.0),
    )
    return dict(zip(LAYER_METRICS, map(float, values), strict=True))


def edge_strain(cloth: Cloth, pos: Tensor) -> Tensor:
    """Relative length change of every edge, (E,), signed."""
    return cloth.edge_strain(pos)


def strain_metrics(cloth: Cloth, pos: Tensor) -> dict[str, float]:
    """Median, 99th percentile and maximum of the absolute edge strain; NaN where ``pos`` (V, 3) is not finite, and
    without edges. Of the same positions it is computed once: a step ends where the next one begins."""
    if pos.device.type != "cpu":
        return _strain_metrics(cloth, pos)
    last, here = _LAST_STRAIN[0] if _LAST_STRAIN else None, pos.detach()
    if last is not None and last[0]() is cloth and last[1].dtype == here.dtype and torch.equal(last[1], here):
        return dict(last[2])
    found = _strain_metrics(cloth, pos)
    _LAST_STRAIN[:] = [(weakref.ref(cloth), here.clone(), found)]
    return dict(found)


#: Cloth and positions that metrics were asked for last, and the metrics.
_LAST_STRAIN: list[tuple[weakref.ref[Cloth], Tensor, dict[str, float]]] = []


def _strain_metrics(cloth: Cloth, pos: Tensor) -> dict[str, float]:
    strain, gathered = absolute_strain(cloth, pos), cloth.gathered_edges
    if strain is None:
        strain = cloth.edge_strain(pos).abs().double().cpu().numpy()
    elif len(gathered):
        strain[gathered.numpy()] = cloth.edge_strain(pos, gathered).abs().double().numpy()
    if len(strain) == 0 or not np.isfinite(strain).all():
        return dict.fromkeys(STRAIN_METRICS, float("nan"))
    strain.sort()
    return dict(zip(STRAIN_METRICS, (_quantile(strain, share) for share in (0.5, 0.99, 1.0)), strict=True))


def _quantile(ascending: np.ndarray, share: float) -> float:
    """What numpy's function says, of values (N,) in ascending order, for a quarter of its time."""
    place = share * (len(ascending) - 1)
    below = int(place)
    low, high = float(ascending[below]), float(ascending[min(below + 1, len(ascending) - 1)])
    return low + (place - below) * (high - low)


def penetration_metrics(contact: Contact | None, cloth: Cloth) -> dict[str, float]:
    """Count, share and depth [m] of the vertices deeper than :data:`PENETRATION_DEPTH` inside the body at t.

    Vertices beyond the reach of the contact energy count as well: there nothing pushes them out. Massless ones do not: they
    belong to no face, nothing moves them, and nobody sees them.
    """
    if contact is None:
        return {"penetration_count": 0.0, "penetration_share": 0.0, "penetration_depth": 0.0}
    # In numpy: a few small calls of torch would take as long as a search.
    dist, seen = contact.dist.detach().cpu().numpy(), cloth.mass.cpu().numpy() > 0
    depth = -dist[np.isfinite(dist) & seen]
    count = int(np.count_nonzero(depth > PENETRATION_DEPTH))
    return {
        "penetration_count": float(count),
        "penetration_share": count / max(int(np.count_nonzero(seen)), 1),
        "penetration_depth": float(depth.max(initial=0.0)),
    }


def vertex_residual(problem: StepProblem, gradient: Tensor) -> Tensor:
    """Relative gradient vertex by vertex: ‖∂Φ/∂x_v‖ / (m_v g), (V,), the force left unbalanced in units of the vertex's own
    weight, from ``gradient`` (V, 3) [N]. 0 where nothing moves.

    Its root mean square, weighted by the squares of the weights, is :func:`hood.energies.potential.relative_gradient`. Standard
    gravity stands in where the problem has none.
    """
    cloth, strength = problem.cloth, float(problem.gravity.norm())
    weight = cloth.mass * (strength if strength > 0 else STANDARD_GRAVITY)
    moves = cloth.free & (weight > 0)
    return torch.where(moves, gradient.norm(dim=1) / torch.where(moves, weight, 1.0), 0.0)


CONVERGED, MOST_ITERATIONS, STOPPED, LATE = "", "max iterations", "stopped", "time budget"
STUCK, NO_PROGRESS, NOT_FINITE = "line search failed", "no progress", "not finite"
#: The number of a reason is its place here; of several scenes the last one counts.
REASONS = (CONVERGED, MOST_ITERATIONS, STOPPED, LATE, NO_PROGRESS, STUCK, NOT_FINITE)


#: What a count of reasons calls the first one.
MET = "converged"


def reason_number(reasons: Sequence[str]) -> float:
    """The reason of the scene that went worst, as a number."""
    return float(max(map(REASONS.index, reasons), default=0))


def count_reasons(numbers: np.ndarray) -> dict[str, int]:
    """How often each reason occurs among ``numbers`` (T,), those of steps that met their target as ``converged``.

    NaN, where no minimisation took place, is left out.
    """
    counts = {reason or MET: int((numbers == number).sum()) for number, reason in enumerate(REASONS)}
    return {reason: count for reason, count in counts.items() if count}


def name_counts(counts: Mapping[str, int]) -> str:
    """``24 max iterations, 3 line search failed``."""
    return ", ".join(f"{count} {reason}" for reason, count in counts.items())


class StepFigures:
    """Figures of one scene's step to ``next_pos``.

    Args:
        potential: what the step is measured by.
        problem: a prepared problem of one scene.
        next_pos: (V, 3) m.
        acc: (V, 3) m/s², what led there.
    """

    gradient: Tensor  # (V, 3) N, ∂Φ/∂x
    energies: dict[str, float]  # J, of the terms that the scene needs

    def __init__(self, potential: Potential, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> None:
        self._potential, self._problem = potential, problem
        self._compiled = compiled_elements.applies(next_pos) and compiled_vertices.applies(next_pos)
        if self._compiled:
            gradient = np.zeros(tuple(next_pos.shape))
            found = self._compiled_energies(compiled_elements.as_double(next_pos), compiled_elements.as_double(acc), gradient)
            self.gradient = torch.from_numpy(gradient)
        else:
            self.gradient, parts = compiled_elements.energies_and_gradient(
                potential, problem, next_pos, acc, by=vertices.energies_and_gradient
            )
            found = {name: float(value) for name, value in parts.items()}
        self.energies = {name: found[name] for name in potential.terms if name in found}

    @np.errstate(all="ignore")  # a step may be anywhere, or nowhere
    def metrics(self) -> dict[str, float]:
        """Energies [J], and for comparison the potential of the inertial guess x_t + dt v_t; gradient norm [N] (the paper's:
        mean over vertices of ‖∂Φ/∂x_v‖₂), rg (:func:`hood.energies.potential.relative_gradient`) and e0 [J]
        (:func:`hood.energies.potential.scale`)."""
        result = {f"energy_{name}": value for name, value in self.energies.items()}
        result["energy_total"] = sum(result.values())
        result["energy_inertial_guess"] = self._of_guess()
        size = np.sqrt(self._forces_sq)
        result["gradient_norm"] = float(size.mean()) if len(size) else 0.0
        result["relative_gradient"] = self.relative_gradient
        dt, mass = float(self._problem.step.dt[0]), compiled_elements.as_double(self._problem.cloth.mass)
        result["e0"] = 0.5 * float(mass.sum()) * (self._gravity * dt) ** 2
        return result

    @cached_property
    @np.errstate(all="ignore")
    def relative_gradient(self) -> float:
        """rg alone: the force left over as a share of the weight."""
        moving = compiled_elements.as_double(self._problem.cloth.mass)[self._free]
        weight_sq = self._gravity**2 * float(moving @ moving)
        return float(np.sqrt(self._forces_sq.sum() / weight_sq)) if weight_sq > 0 else 0.0

    @cached_property
    def _forces_sq(self) -> np.ndarray:
        """(N,) N², ‖∂Φ/∂x_v‖² of the free vertices."""
        slope = compiled_elements.as_double(self.gradient)
        return np.asarray(np.einsum("vi,vi->v", slope, slope)[self._free])

    @property
    def _free(self) -> np.ndarray:
        return np.asarray(self._problem.cloth.free.cpu().numpy())

    @cached_property
    def _gravity(self) -> float:
        return float(np.linalg.norm(compiled_elements.as_double(self._problem.gravity))) or STANDARD_GRAVITY

    def _of_guess(self) -> float:
        """Φ [J] where the cloth would be without forces, pins where they go."""
        problem, dt = self._problem, float(self._problem.step.dt[0])
        state, target = problem.state, problem.step.pin_target
        guess = compiled_elements.as_double(state.pos) + dt * compiled_elements.as_double(state.vel)
        acc = np.zeros_like(guess)
        if target is not None:
            pinned = problem.cloth.pinned.cpu().numpy()
            goal = compiled_elements.as_double(target)[pinned]
            acc[pinned] = (goal - guess[pinned]) / dt**2
            guess[pinned] = goal
        if self._compiled:
            return sum(self._compiled_energies(guess, acc, None).values())
        pos = torch.from_numpy(guess).to(state.pos)
        return float(compiled_elements.total_energy(self._potential, problem, pos, by=vertices.total_energy).sum())

    def _compiled_energies(self, pos: np.ndarray, acc: np.ndarray, gradient: np.ndarray | None) -> dict[str, float]:
        """Energies [J] by term, other terms than those of the passes by torch; their gradient is added to ``gradient``."""
        problem = self._problem
        found = compiled_elements.element_energies(self._potential, problem, pos, gradient)
        energies = {name: float(value[0]) for name, value in found.items()}
        others = compiled_elements.split(self._potential)[0]
        single, rest = vertices.split(others)
        names = vertices.part_names(single, problem)
        if names is not None:
            others, step, forces = rest, problem.step, vertices.known_forces(single, problem)
            parts = forces.compiled.add(pos, acc, problem.cloth.vertex_scene, step.dt, gradient)
            for name, value in zip(names, parts[:, 0].tolist(), strict=True):
                if name:  # contact on both sides of a fold is two parts of one term
                    energies[name] = energies.get(name, 0.0) + value
        if not others.active(problem):
            return energies
        place, given = (torch.from_numpy(values).to(problem.state.pos) for values in (pos, acc))
        zero = {name: term for name, term in others.terms.items() if is_energy(term) and term.is_zero(problem, place)}
        if zero:  # a gradient by autograd takes as long as all other terms
            energies |= dict.fromkeys(zero, 0.0)
            others = others.only({name: term for name, term in others.terms.items() if name not in zero})
        if not others.active(problem):
            return energies
        if gradient is None:
            return energies | {name: float(value) for name, value in others.energies(problem, place, given).items()}
        slope, parts_of_rest = others.gradient(problem, place, given)
        gradient += compiled_elements.as_double(slope)
        return energies | {name: float(value) for name, value in parts_of_rest.items()}
