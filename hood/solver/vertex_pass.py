"""Collision and friction terms as C++ reads them, and the compiled pass over what acts on single vertices."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from hood.losses.elements import library
from hood.native.structures import COUNT, POINTER, REAL, fields

if TYPE_CHECKING:
    from hood.solver.forces import Grip, VertexForces, Walls


class WallStructure(ctypes.Structure):
    """``Wall`` of ``vertex_terms.h``."""

    _fields_ = [*fields("point normal reach", POINTER), ("weight", REAL), ("share", POINTER)]


class GripStructure(ctypes.Structure):
    """``Grip`` of ``vertex_terms.h``."""

    _fields_ = fields("force normal anchor limit", POINTER)


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
        structure.weight = 1.0 if isinstance(wall.weight, Tensor) else wall.weight
        if isinstance(wall.weight, Tensor):
            kept.append(whole(wall.weight))
            structure.share = kept[-1].data_ptr()
    return structures, kept


def grip_structures(grips: tuple[Grip, ...]) -> tuple[ctypes.Array[GripStructure], list[Tensor]]:
    """The same for grips."""
    structures, kept = (GripStructure * len(grips))(), list[Tensor]()
    for structure, grip in zip(structures, grips, strict=True):
        kept += _pointed(structure, grip, ("force", "normal", "anchor", "limit"))
    return structures, kept


def _pointed(structure: ctypes.Structure, item: Walls | Grip, names: tuple[str, ...]) -> list[Tensor]:
    tensors = [whole(getattr(item, name)) for name in names]
    for name, tensor in zip(names, tensors, strict=True):
        setattr(structure, name, tensor.data_ptr())
    return tensors


def whole(values: Tensor) -> Tensor:
    """In float64 without gaps: itself where it is that."""
    sound = values.dtype is torch.float64 and values.is_contiguous() and not values.requires_grad
    return values if sound else values.detach().double().contiguous()


def evaluate(
    forces: VertexForces, pos: Tensor, acc: Tensor, scene: Tensor, dt: Tensor, gradient: bool
) -> tuple[Tensor, Tensor | None] | None:
    """Energies [J] (2 + W + G, B) of inertia, gravity, walls and grips, and where asked for their gradient [N] (V, 3), float64.

    Args:
        pos, acc: (V, 3) m and m/s².
        scene, dt: of every vertex (V,), and seconds of each (B,).

    Returns:
        None where there is no compiled pass, or not for these tensors.
    """
    lib = library() if type(pos) is Tensor and pos.device.type == "cpu" else None
    if lib is None:
        return None
    walls, grips = wall_structures(forces.walls), grip_structures(forces.grips)
    constants = [whole(forces.inertia), whole(forces.stiffness), whole(forces.weight), whole(dt)]
    given = [whole(pos), whole(acc)]
    vertices = _Vertices(
        len(pos),
        len(dt),
        len(walls[0]),
        len(grips[0]),
        scene.data_ptr(),
        *(values.data_ptr() for values in constants),
        ctypes.addressof(walls[0]),
        ctypes.addressof(grips[0]),
    )
    energies = np.zeros((2 + len(walls[0]) + len(grips[0]), len(dt)))
    slope = np.zeros(tuple(pos.shape)) if gradient else None
    into = None if slope is None else POINTER(slope.ctypes.data)
    addresses = [POINTER(values.data_ptr()) for values in given]
    lib.elements_vertices(ctypes.byref(vertices), *addresses, POINTER(energies.ctypes.data), into)
    return torch.from_numpy(energies), None if slope is None else torch.from_numpy(slope)
