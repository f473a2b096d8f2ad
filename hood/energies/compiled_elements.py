"""Membrane and bending of a step in one compiled pass (``hood/native/elements.cpp``): energies, gradient, edge strain.

Float64 whatever the cloth is in. The reference is :class:`hood.energies.potential.Potential`, which computes all other terms,
and these too where there is no compiler and on an accelerator.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from hood import native
from hood.cloth.cloth import Cloth
from hood.energies.bending import Bending, CurrentLengthBending, bending_weight
from hood.energies.membrane import Stretching, weave_roots
from hood.energies.problem import StepProblem
from hood.native.arguments import COUNT, POINTER, fields
from hood.native.build import optional
from hood.tensors.batch import made_of

if TYPE_CHECKING:  # potentials use this pass
    from hood.energies.potential import Potential, Term

_SOURCE = Path(native.__file__).with_name("elements.cpp")
_LANES = 8
#: Terms of the pass. A subclass may compute something else and does not count.
ELEMENT_TERMS = (Stretching, Bending, CurrentLengthBending)

#: Energies [J] (B,) by term, and their gradient [N] (V, 3) before them, of a potential.
Evaluate = Callable[["Potential", StepProblem, Tensor, Tensor | None], tuple[Tensor, dict[str, Tensor]]]

#: Potential [J] (B,) of a step at positions (V, 3).
Sum = Callable[["Potential", StepProblem, Tensor], Tensor]


class _Faces(ctypes.Structure):
    _fields_ = [*fields("count padded", COUNT), *fields("corners scene inverse weight mu lambda_ weave", POINTER)]


class _Hinges(ctypes.Structure):
    _fields_ = [*fields("count padded current_length", COUNT), *fields("corners scene weight rest_angle", POINTER)]


class _Constants(NamedTuple):
    """What the pass reads of a cloth; the arrays that the structures point to are kept with them."""

    faces: _Faces
    hinges: _Hinges
    current_hinges: _Hinges
    edges: np.ndarray  # (E, 2)
    edge_length: np.ndarray  # (E,) m, at rest
    kept: list[np.ndarray]


@cache
def library() -> ctypes.CDLL | None:
    """The compiled pass; None without a compiler."""
    return optional(_SOURCE)


def _by_gradient(
    potential: Potential, problem: StepProblem, next_pos: Tensor, acc: Tensor | None
) -> tuple[Tensor, dict[str, Tensor]]:
    return potential.gradient(problem, next_pos, acc)


def _by_total(potential: Potential, problem: StepProblem, next_pos: Tensor) -> Tensor:
    return potential.total(problem, next_pos)


def energies_and_gradient(
    potential: Potential, problem: StepProblem, next_pos: Tensor, acc: Tensor | None = None, by: Evaluate = _by_gradient
) -> tuple[Tensor, dict[str, Tensor]]:
    """What :meth:`hood.energies.potential.Potential.gradient` computes, element terms by the compiled pass and others ``by``
    another function."""
    if not applies(next_pos):
        return by(potential, problem, next_pos, acc)
    others, _ = split(potential)
    gradient = np.zeros(tuple(next_pos.shape))
    values = element_energies(potential, problem, as_double(next_pos), gradient)
    total = torch.from_numpy(gradient)
    if others.active(problem):  # a gradient of nothing takes as long as the pass
        rest, found = by(others, problem, next_pos, acc)
        total, values = rest.double() + total, values | found
    return total, {name: values[name] for name in potential.terms if name in values}


@torch.no_grad()
def total_energy(potential: Potential, problem: StepProblem, next_pos: Tensor, by: Sum = _by_total) -> Tensor:
    """Potential Φ [J] per scene (B,), what :meth:`hood.energies.potential.Potential.total` computes, element terms by the
    compiled pass and others ``by`` another function."""
    if not applies(next_pos):
        return by(potential, problem, next_pos)
    others, _ = split(potential)
    values = element_energies(potential, problem, as_double(next_pos), None).values()
    return sum(values, start=by(others, problem, next_pos).double())


def absolute_strain(cloth: Cloth, pos: Tensor) -> np.ndarray | None:
    """Absolute relative length change of every edge (E,), float64; None where there is no compiled pass."""
    lib = library() if applies(pos) else None
    if lib is None:
        return None
    constants, place = _constants_of(cloth), as_double(pos)
    strain = np.empty(len(constants.edges))
    arrays = (constants.edges, constants.edge_length, place, strain)
    lib.elements_strain(COUNT(len(strain)), *(POINTER(array.ctypes.data) for array in arrays))
    return strain


def applies(pos: Tensor) -> bool:
    """Whether there is a compiled pass for these positions."""
    return type(pos) is Tensor and pos.device.type == "cpu" and library() is not None


def split(potential: Potential) -> tuple[Potential, dict[str, Term]]:
    """The terms that torch computes, and those of the pass."""
    elements = {name: term for name, term in potential.terms.items() if type(term) in ELEMENT_TERMS}
    return potential.only({name: term for name, term in potential.terms.items() if name not in elements}), elements


def element_energies(
    potential: Potential, problem: StepProblem, pos: np.ndarray, gradient: np.ndarray | None
) -> dict[str, Tensor]:
    """Energies [J] (B,) of the element terms that the problem needs, at ``pos`` (V, 3); their gradient is added to ``gradient``
    (V, 3). Both float64 without gaps."""
    lib, constants = library(), _constants_of(problem.cloth)
    assert lib is not None
    energies = {}
    for name, term in split(potential)[1].items():
        if not term.applies(problem):
            continue
        energy = np.zeros(problem.num_scenes)
        work, table = lib.elements_hinges, ctypes.byref(constants.hinges)
        if type(term) is Stretching:
            work, table = lib.elements_faces, ctypes.byref(constants.faces)
        elif type(term) is CurrentLengthBending:
            table = ctypes.byref(constants.current_hinges)
        into = None if gradient is None else POINTER(gradient.ctypes.data)
        work(table, POINTER(pos.ctypes.data), POINTER(energy.ctypes.data), into)
        energies[name] = torch.from_numpy(energy)
    return energies


def along_membrane(cloth: Cloth, pos: np.ndarray, direction: np.ndarray, product: np.ndarray) -> np.ndarray:
    """How the slope of the membrane's energy at ``pos`` (V, 3) along ``direction`` (V, 3) [m] changes with the numbers of every
    face, (9, F): volume; μ, λ and two zeros, or the roots of its weave; the four of the inverse rest edges. The product of the
    Hessian with the direction is added to ``product`` (V, 3). All float64 without gaps."""
    faces = _constants_of(cloth).faces
    return _along(library().elements_faces_along, faces, 9, pos, direction, product)  # type: ignore[union-attr]


def along_bending(cloth: Cloth, pos: np.ndarray, direction: np.ndarray, product: np.ndarray) -> np.ndarray:
    """The same of bending about the rest shape, (2, H) by the weight and the rest angle of every hinge."""
    hinges = _constants_of(cloth).hinges
    return _along(library().elements_hinges_along, hinges, 2, pos, direction, product)  # type: ignore[union-attr]


def _along(work: Any, table: _Faces | _Hinges, rows: int, *vectors: np.ndarray) -> np.ndarray:
    by = np.empty((rows, table.padded))
    work(ctypes.byref(table), *(POINTER(array.ctypes.data) for array in (*vectors, by)))
    return by[:, : table.count]


def _constants_of(cloth: Cloth) -> _Constants:
    """Kept as long as the cloth lives."""
    made = made_of(cloth)
    if "constants" not in made:
        made["constants"] = _make_constants(cloth)
    constants: _Constants = made["constants"]
    return constants


def _make_constants(cloth: Cloth) -> _Constants:
    stiffness, area = cloth.bending_stiffness.double(), cloth.hinge_area.double()
    faces = (cloth.faces, cloth.face_scene, cloth.rest_inverse.flatten(1), cloth.rest_area.double() * cloth.thickness.double())
    weights = (
        bending_weight(stiffness, length_sq, area)
        for length_sq in (cloth.hinge_rest_length.double() ** 2, torch.ones_like(area))
    )
    tables = [[*faces, cloth.lame_mu, cloth.lame_lambda]]
    tables += [[cloth.hinges, cloth.hinge_scene, weight, cloth.rest_angle] for weight in weights]
    kept = [[_padded(tensor) for tensor in table] for table in tables]
    roots = weave_roots(cloth, torch.float64)
    weave = [] if roots is None else [_padded(roots.t())]
    sizes = [(len(elements), table[1].shape[-1]) for elements, table in zip((cloth.faces, cloth.hinges), kept, strict=False)]
    return _Constants(
        _Faces(*sizes[0], *(array.ctypes.data for array in (*kept[0], *weave))),
        _Hinges(*sizes[1], 0, *(array.ctypes.data for array in kept[1])),
        _Hinges(*sizes[1], 1, *(array.ctypes.data for array in kept[2])),
        _whole(cloth.edges),
        _whole(_rest_length(cloth)),
        [array for table in (*kept, weave) for array in table],
    )


def _rest_length(cloth: Cloth) -> Tensor:
    """(E,) m in float64: of edges of a mesh the difference is not rounded."""
    if cloth.flat is not None:
        return cloth.rest_length.double()
    rest, (start, end) = cloth.rest_pos.double(), cloth.edges.unbind(dim=1)
    return (rest[end] - rest[start]).norm(dim=1)


def _padded(values: Tensor) -> np.ndarray:
    """Columns (N,) or (C, N) of elements (N,) or (N, C), N filled up to a multiple of eight: with what weighs nothing."""
    array = values.detach().numpy().T
    kind = np.float64 if values.is_floating_point() else np.int32
    whole = np.zeros((*array.shape[:-1], -(-array.shape[-1] // _LANES) * _LANES), kind)
    whole[..., : array.shape[-1]] = array
    return whole


def _whole(values: Tensor) -> np.ndarray:
    return np.ascontiguousarray(values.detach().numpy(), np.float64 if values.is_floating_point() else np.int64)


def as_double(values: Tensor) -> np.ndarray:
    """The same in float64 without gaps, on the host."""
    return np.ascontiguousarray(values.detach().cpu().numpy(), np.float64)
