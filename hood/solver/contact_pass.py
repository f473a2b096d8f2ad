"""Planes of the default collision term and grips of the default friction term in one compiled pass over the vertices.

What :class:`hood.losses.collision.Collision` and :class:`hood.losses.friction.Friction` say in some forty operations of torch,
which takes longer than the solver's pass over all elements.
"""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from hood.losses.collision import Collision
from hood.losses.elements import library
from hood.losses.friction import Friction, gripped
from hood.losses.problem import StepProblem
from hood.native.structures import COUNT, POINTER, REAL, fields
from hood.scene.contact import Contact
from hood.scene.reach import sag
from hood.solver.vertex_pass import whole


class _Contact(ctypes.Structure):
    """``Contact`` of ``elements.cpp``."""

    _fields_ = [
        ("count", COUNT),
        *fields("valid scene mass pos vel dist sag point next_point next_normal pull dt gravity", POINTER),
    ]


class _Reach(ctypes.Structure):
    """``Reach`` of ``elements.cpp``."""

    _fields_ = [("least", REAL), ("curved", COUNT)]


class ContactPass:
    """The contact of a step as C++ reads it; made by :func:`contact_pass`."""

    def __init__(self, lib: ctypes.CDLL, problem: StepProblem, contact: Contact) -> None:
        self._lib, self._problem, self._face = lib, problem, contact.face
        cloth, state = problem.cloth, problem.state
        self._values = _Contact(count=len(state.pos))
        given = {name: getattr(contact, name) for name in ("dist", "point", "next_point", "next_normal")}
        given |= {"mass": cloth.mass, "sag": sag(cloth, contact, state.pos), "pos": state.pos, "vel": state.vel}
        given |= {"dt": problem.step.dt, "gravity": problem.gravity}
        self._kept = {name: whole(values) for name, values in given.items()}
        self._kept |= {"valid": contact.valid.contiguous(), "scene": cloth.vertex_scene.contiguous()}
        for name, values in self._kept.items():
            setattr(self._values, name, values.data_ptr())

    def planes(self, term: Collision) -> list[Tensor]:
        """Points [m] (V, 3), normals (V, 3) and distances [m] (V,) of :class:`hood.solver.forces.Walls`."""
        found = self._empty(2, 1)
        self._lib.elements_wall(*self._given(term), *_addresses(found))
        return found

    def grips(self, term: Friction) -> list[Tensor]:
        """Normals (V, 3), anchors [m] (V, 3), forces [N] (V,) and limits [m] (V,) of :class:`hood.solver.forces.Grip`."""
        pull = self._problem.searched_pull
        if pull is not None:
            self._kept["pull"] = whole(pull)
            self._values.pull = self._kept["pull"].data_ptr()
        found = self._empty(2, 2)
        numbers = (REAL(value) for value in (term.weight, term.coefficient, term.slip_speed))
        self._lib.elements_grip(*self._given(term), *numbers, *_addresses(found))
        found[2].mul_(self._problem.cloth.friction)
        found[2] = gripped(self._problem, self._face, found[2])
        return found

    def _given(self, term: Collision | Friction) -> tuple[object, object]:
        reach = _Reach(term.epsilon, term.reach == "curvature")
        return ctypes.byref(self._values), ctypes.byref(reach)

    def _empty(self, vectors: int, numbers: int) -> list[Tensor]:
        pos = self._kept["pos"]
        return [torch.empty_like(pos) for _ in range(vectors)] + [pos.new_empty(len(pos)) for _ in range(numbers)]


def contact_pass(problem: StepProblem, contact: Contact) -> ContactPass | None:
    """The pass over a contact of a step in float64; None where there is no compiled pass, or not for these tensors."""
    pos = problem.state.pos
    plain = type(pos) is Tensor and pos.device.type == "cpu" and not pos.requires_grad
    if not plain or pos.dtype is not torch.float64:
        return None
    lib = library()
    return None if lib is None else ContactPass(lib, problem, contact)


def _addresses(tensors: list[Tensor]) -> list[ctypes.c_void_p]:
    return [POINTER(values.data_ptr()) for values in tensors]
