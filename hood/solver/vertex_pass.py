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
    from hood.solver.drag import Drag
    from hood.solver.forces import Grip, VertexForces, Walls


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
