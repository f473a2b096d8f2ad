"""Cloth near cloth in a batch of scenes: what is found out about a cloth once, and about each of its steps."""

from __future__ import annotations

import weakref
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hood.mesh.kept import forget
from hood.mesh.layer_pins import Followed, follow
from hood.mesh.layers import Contacts, LayerMesh, Layers
from hood.scene.cloth import Cloth


@dataclass(frozen=True)
class SceneLayers:
    """The layers of one scene, and where its vertices are in the batch."""

    layers: Layers
    first: int
    last: int
    at_start: Contacts | None = None  # what is within its reach where the step begins, if anybody asked
    pins: Followed | None = None  # where held vertices come to; None without any

    def of(self, values: Tensor) -> np.ndarray:
        """This scene's rows of ``values`` (V, 3), float64."""
        return values[self.first : self.last].detach().cpu().double().numpy()

    def near_at_start(self, pos: Tensor) -> Contacts:
        """What is within its reach where the step begins, at ``pos`` (V, 3) m."""
        return self.layers.contacts(self.of(pos)) if self.at_start is None else self.at_start

    def begun_at(self, pos: Tensor) -> SceneLayers:
        """The same with ways that begin at ``pos`` (V, 3) m; what was near what where the step begins is still known."""
        return SceneLayers(self.layers.begun_at(self.of(pos)), self.first, self.last, self.at_start, self.pins)


def find_layers(
    cloth: Cloth, pos: Tensor, ahead: Tensor, reach: float, pressure: float, between: bool
) -> tuple[SceneLayers, ...]:
    """The layers of every scene at ``pos`` (V, 3), from where the step may lead to ``ahead`` (V, 3): targets of held vertices
    are in there, which may be out of reach (:func:`late_targets`). See :class:`hood.mesh.layers.Layers`."""
    found = []
    for mesh, first, last in _meshes(cloth, reach):
        fixed, pinned = (~cloth.free[first:last]).cpu().numpy(), cloth.pinned[first:last].cpu().numpy()
        here, there = (values[first:last].detach().cpu().double().numpy() for values in (pos, ahead))
        held = bool(pinned.any() and np.isfinite(here).all() and np.isfinite(there[pinned]).all())
        there = np.where(np.isfinite(there), there, here)
        layers, pins = Layers(mesh, here, fixed, pressure, between, there), None
        if held:
            pins = follow(layers, here, pinned, there)
            if pins.late:
                short = torch.as_tensor(pins.pos).to(ahead).cpu().double().numpy()
                there = np.where((pins.lag > 0)[:, None], short, there)
                layers = Layers(mesh, here, fixed, pressure, between, there)
            layers.resort_to(np.where(pinned[:, None], there, np.where(fixed[:, None], here, pins.pos)))
        found.append(SceneLayers(layers, first, last, pins=pins))
    return tuple(found)


def late_targets(layers: tuple[SceneLayers, ...], target: Tensor) -> Tensor:
    """``target`` (V, 3) of held vertices, where they come to in the step; itself where all of them can be reached."""
    if not any(scene.pins is not None and scene.pins.late for scene in layers):
        return target
    reached = target.clone()
    for scene in layers:
        if scene.pins is not None:
            late = torch.as_tensor(scene.pins.lag > 0, device=target.device).unsqueeze(1)
            own = reached[scene.first : scene.last]
            own.copy_(torch.where(late, torch.as_tensor(scene.pins.pos).to(target), own))
    return reached


_MESHES: dict[tuple[int, float], tuple[weakref.ref[Tensor], list[tuple[LayerMesh, int, int]]]] = {}


def _meshes(cloth: Cloth, reach: float) -> list[tuple[LayerMesh, int, int]]:
    """Mesh and range of vertices of every scene, kept as long as the cloth's faces live."""
    key = id(cloth.faces), reach
    known = _MESHES.get(key)
    if known is not None and known[0]() is cloth.faces:
        return known[1]
    rest, faces = cloth.rest_pos.cpu().double().numpy(), cloth.faces.cpu().numpy()
    bounds = torch.searchsorted(cloth.vertex_scene.cpu(), torch.arange(cloth.num_scenes + 1)).tolist()
    scene, made = cloth.face_scene.cpu().numpy(), []
    for index, (first, last) in enumerate(zip(bounds, bounds[1:], strict=False)):
        made.append((LayerMesh(rest[first:last], faces[scene == index] - first, reach), first, last))
    _MESHES[key] = weakref.ref(cloth.faces, forget(_MESHES, key)), made
    return made
