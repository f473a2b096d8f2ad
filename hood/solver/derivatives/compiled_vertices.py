"""Collision and friction terms as C++ reads them, and the compiled pass over what acts on single vertices.

Planes of the default collision term and grips of the default friction term in one compiled pass over the vertices.

What :class:`hood.energies.contact.Collision` and :class:`hood.energies.friction.Friction` say in some forty operations of
torch, which takes longer than the solver's pass over all elements.
"""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from hood.contact.contact import AHEAD, Contact, skin_of
from hood.contact.sample_points import MOST_SAG, MOST_STRETCHED, SAG_SHARE, chord_error
from hood.energies.compiled_elements import library
from hood.energies.contact import Collision, Walls
from hood.energies.friction import Friction, Grip, scaled_by_body_friction
from hood.energies.problem import StepProblem
from hood.native.arguments import COUNT, POINTER, REAL, fields

if TYPE_CHECKING:
    from hood.energies.wind import Drag
    from hood.solver.derivatives.vertices import VertexForces


class WallStructure(ctypes.Structure):
    """``Wall`` of ``vertex_terms.h``."""

    _fields_ = [*fields("point normal reach", POINTER), ("weight", REAL), ("share", POINTER)]


class GripStructure(ctypes.Structure):
    """``Grip`` of ``vertex_terms.h``."""

    _fields_ = fields("force normal anchor limit", POINTER)


class DragStructure(ctypes.Structure):
    """``Drag`` of ``vertex_terms.h``."""

    _fields_ = fields("normal target across along", POINTER)


class _Vertices(ctypes.Structure):
    """``Vertices`` of ``elements.cpp``."""

    _fields_ = [
        *fields("count num_scenes num_walls num_grips", COUNT),
        *fields("scene inertia stiffness weight dt walls grips", POINTER),
    ]


def wall_structures(walls: tuple[Walls, ...]) -> tuple[ctypes.Array[WallStructure], list[Tensor]]:
    """Walls as C++ reads them, and what they point to."""
    structures, kept = (WallStructure * len(walls))(), list[Tensor]()
    for structure, wall in zip(structures, walls, strict=True):
        kept += _pointed(structure, wall, ("point", "normal", "reach"))
        if isinstance(wall.weight, Tensor) and wall.weight.ndim:
            structure.weight = 1.0
            kept.append(whole(wall.weight))
            structure.share = kept[-1].data_ptr()
        else:
            structure.weight = float(wall.weight)
    return structures, kept


def grip_structures(grips: tuple[Grip, ...]) -> tuple[ctypes.Array[GripStructure], list[Tensor]]:
    """The same for grips."""
    structures, kept = (GripStructure * len(grips))(), list[Tensor]()
    for structure, grip in zip(structures, grips, strict=True):
        kept += _pointed(structure, grip, ("force", "normal", "anchor", "limit"))
    return structures, kept


def drag_structures(drags: tuple[Drag, ...]) -> tuple[ctypes.Array[DragStructure], list[Tensor]]:
    """The same for drags."""
    structures, kept = (DragStructure * len(drags))(), list[Tensor]()
    for structure, drag in zip(structures, drags, strict=True):
        kept += _pointed(structure, drag, ("normal", "target", "across", "along"))
    return structures, kept


def _pointed(structure: ctypes.Structure, item: Walls | Grip | Drag, names: tuple[str, ...]) -> list[Tensor]:
    tensors = [whole(getattr(item, name)) for name in names]
    for name, tensor in zip(names, tensors, strict=True):
        setattr(structure, name, tensor.data_ptr())
    return tensors


def whole(values: Tensor) -> Tensor:
    """In float64 without gaps: itself where it is that."""
    sound = values.dtype is torch.float64 and values.is_contiguous() and not values.requires_grad
    return values if sound else values.detach().double().contiguous()


def applies(pos: Tensor) -> bool:
    """Whether there is a compiled pass for these positions."""
    return type(pos) is Tensor and pos.device.type == "cpu" and library() is not None


class VertexPass:
    """Forces of a step as C++ reads them, for as many evaluations as are asked for.

    Args:
        forces: what acts on the vertices; it must stay as it is.
    """

    def __init__(self, forces: VertexForces) -> None:
        self._walls, self._grips = wall_structures(forces.walls), grip_structures(forces.grips)
        self._constants = [whole(values) for values in (forces.inertia, forces.stiffness, forces.weight)]
        self._num_parts = 2 + len(forces.walls) + len(forces.grips)
        self._structure = _Vertices(
            count=len(forces.stiffness),
            num_walls=len(forces.walls),
            num_grips=len(forces.grips),
            inertia=self._constants[0].data_ptr(),
            stiffness=self._constants[1].data_ptr(),
            weight=self._constants[2].data_ptr(),
            walls=ctypes.addressof(self._walls[0]),
            grips=ctypes.addressof(self._grips[0]),
        )

    def evaluate(self, pos: Tensor, acc: Tensor, scene: Tensor, dt: Tensor, gradient: bool) -> tuple[Tensor, Tensor | None]:
        """Energies [J] (2 + W + G, B) of inertia, gravity, walls and grips, and where asked for their gradient [N] (V, 3),
        float64.

        Args:
            pos, acc: (V, 3) m and m/s².
            scene, dt: of every vertex (V,), and seconds of each (B,).
        """
        slope = np.zeros(tuple(pos.shape)) if gradient else None
        energies = self.add(whole(pos).numpy(), whole(acc).numpy(), scene, dt, slope)
        return torch.from_numpy(energies), None if slope is None else torch.from_numpy(slope)

    def add(self, pos: np.ndarray, acc: np.ndarray, scene: Tensor, dt: Tensor, gradient: np.ndarray | None) -> np.ndarray:
        """The energies of :meth:`evaluate`; their gradient is added to ``gradient`` (V, 3). All float64 without gaps."""
        lib = library()
        assert lib is not None
        structure, seconds = self._structure, whole(dt)
        structure.num_scenes, structure.scene, structure.dt = len(dt), scene.data_ptr(), seconds.data_ptr()
        energies = np.zeros((self._num_parts, len(dt)))
        arrays = (pos, acc, energies, gradient)
        lib.elements_vertices(ctypes.byref(structure), *(None if a is None else POINTER(a.ctypes.data) for a in arrays))
        return energies


class _Contact(ctypes.Structure):
    """``Contact`` of ``elements.cpp``."""

    _fields_ = [
        ("count", COUNT),
        *fields("valid scene mass pos vel dist chord_error point next_point next_normal pull dt gravity", POINTER),
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
        given |= {"mass": cloth.mass, "chord_error": chord_error(cloth, contact, state.pos), "pos": state.pos, "vel": state.vel}
        given |= {"dt": problem.step.dt, "gravity": problem.gravity}
        self._kept = {name: whole(values) for name, values in given.items()}
        self._kept |= {"valid": contact.valid.contiguous(), "scene": cloth.vertex_scene.contiguous()}
        for name, values in self._kept.items():
            setattr(self._values, name, values.data_ptr())

    def planes(self, term: Collision) -> list[Tensor]:
        """Points [m] (V, 3), normals (V, 3) and distances [m] (V,) of :class:`hood.solver.derivatives.vertices.Walls`."""
        found = self._empty(2, 1)
        self._lib.elements_wall(*self._given(term), *_addresses(found))
        return found

    def grips(self, term: Friction) -> list[Tensor]:
        """Normals (V, 3), anchors [m] (V, 3), forces [N] (V,) and limits [m] (V,) of
        :class:`hood.solver.derivatives.vertices.Grip`."""
        pull = self._problem.searched_internal_force
        if pull is not None:
            self._kept["pull"] = whole(pull)
            self._values.pull = self._kept["pull"].data_ptr()
        found = self._empty(2, 2)
        numbers = (REAL(value) for value in (term.weight, term.coefficient, term.slip_speed))
        self._lib.elements_grip(*self._given(term), *numbers, *_addresses(found))
        found[2].mul_(self._problem.cloth.friction)
        found[2] = scaled_by_body_friction(self._problem, self._face, found[2])
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


class _FollowedContact(ctypes.Structure):
    """``FollowedContact`` of ``followed_contact.h``."""

    _fields_ = fields("valid face bary dist normal raised", POINTER)


class _Followed(ctypes.Structure):
    """``Followed`` of ``followed_contact.h``."""

    _fields_ = [
        ("count", COUNT),
        *fields("faces surface next_surface normals next_normals curvature friction_scale", POINTER),
        ("first", _FollowedContact),
        ("second", _FollowedContact),
        *fields("scene mass friction edge_sq growth pos vel pull next_pos dt gravity", POINTER),
        *fields("ahead sag_share most_sag most_stretched", REAL),
    ]


class _FollowedTerm(ctypes.Structure):
    """``FollowedTerm`` of ``followed_contact.h``."""

    _fields_ = [*fields("weight least", REAL), ("curved", COUNT), *fields("coefficient slip_speed", REAL)]


class FollowedBody:
    """Contact of a step with the body as C++ follows it, where the body itself is constant.

    Args:
        problem: of numbers alone, with its contacts and the forces of the cloth around.
        next_pos: (V, 3) m.
        growth: (V,) m² of the edges (:mod:`hood.contact.sample_points`), or None.
    """

    def __init__(self, problem: StepProblem, next_pos: Tensor, growth: Tensor | None) -> None:
        contact, obstacle, cloth = problem.contact, problem.step.obstacle, problem.cloth
        assert contact is not None
        assert obstacle is not None
        skin = skin_of(obstacle)
        given = {"surface": obstacle.pos, "next_surface": obstacle.next_pos, "friction_scale": obstacle.friction_scale}
        given |= {"normals": skin.normal, "next_normals": skin.next_normal, "curvature": skin.curvature}
        given |= {"mass": cloth.mass, "friction": cloth.friction, "edge_sq": cloth.edge_length_sq, "growth": growth}
        given |= {"pos": problem.state.pos, "vel": problem.state.vel, "pull": problem.searched_internal_force}
        given |= {"next_pos": next_pos, "dt": problem.step.dt, "gravity": problem.gravity}
        self._kept = [whole(values) for values in given.values() if values is not None]
        self._values = _Followed(count=len(next_pos), ahead=AHEAD, sag_share=SAG_SHARE, most_sag=MOST_SAG)
        self._values.most_stretched = MOST_STRETCHED
        for name, values in zip((name for name, one in given.items() if one is not None), self._kept, strict=True):
            setattr(self._values, name, values.data_ptr())
        self._keep(self._values, "faces", obstacle.faces)
        self._keep(self._values, "scene", cloth.vertex_scene)
        self._take(self._values.first, contact)
        if problem.second_contact is not None and problem.second_contact.contact is not None:
            self._take(self._values.second, problem.second_contact.contact)

    def along(self, term: Collision | Friction, direction: Tensor) -> Tensor:
        """How the term's force along ``direction`` (V, 3) [m] changes, (V, 16) of every vertex: with its position at t (3) and
        its velocity (3), with the force of the cloth around (3), its mass, its factor of friction, its mean square of the edges
        and their growth; then what it is."""
        both = (getattr(term, name, 0.0) for name in ("coefficient", "slip_speed"))  # contact has none
        numbers = (value.detach() if isinstance(value, Tensor) else value for value in both)
        own = _FollowedTerm(term.weight, term.epsilon, term.reach == "curvature", *map(float, numbers))
        found = direction.new_zeros(len(direction), 16)
        lib = library()
        assert lib is not None
        structures = ctypes.byref(self._values), ctypes.byref(own)
        lib.elements_followed(*structures, *_addresses([whole(direction), found]))
        return found

    def _take(self, into: _FollowedContact, contact: Contact) -> None:
        for name in ("valid", "face"):
            self._keep(into, name, getattr(contact, name))
        for name in ("bary", "dist", "normal", "raised"):
            if getattr(contact, name) is not None:
                self._keep(into, name, whole(getattr(contact, name)))

    def _keep(self, into: ctypes.Structure, name: str, values: Tensor) -> None:
        self._kept.append(values.contiguous())
        setattr(into, name, self._kept[-1].data_ptr())
