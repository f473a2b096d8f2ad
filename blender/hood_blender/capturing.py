"""Capturing a bake's body, garments and pins into files: generators that do a frame at a time."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from . import capture, command, meshes, state
from .body_file import BodyFile, is_body_file
from .fault import BakeError
from .lookup import fps_of, object_named, scale_of, scene_named
from .plan import Captured, Plan, Progress

#: A body is captured twice a frame where its fastest vertex moves farther than this in one [m].
FAR = 0.05
#: Farther from the origin than this [m] everything is moved near to it: hood and PC2 files hold single precision.
_FAR_OUT = 10.0
#: Farther than this [m] from there hood's point caches would change their origin.
_FARTHEST = 30.0
#: Frames that say whether a body still moves as it was captured.
_PROBES = 5


def capture_all(plan: Plan, progress: Progress, found: list[Captured]) -> Iterator[float]:
    """Capture body and garments; the body only where it is not there as it moves now. The frame of the scene comes back."""
    scene = scene_named(plan.scene)
    before = (scene.frame_current, scene.frame_subframe)
    try:
        yield from _captured(plan, progress, found)
    finally:
        try:
            scene_named(plan.scene).frame_set(before[0], subframe=before[1])
        except BakeError:
            pass


def _captured(plan: Plan, progress: Progress, found: list[Captured]) -> Iterator[float]:
    progress.work, progress.total = "Capturing", plan.last - plan.first + 1
    scene, body = scene_named(plan.scene), object_named(plan.body, plan.body_uid)
    scale = scale_of(scene)
    depsgraph = capture.evaluated(scene, plan.layer, plan.first)
    middle = capture.body_pose(depsgraph, body, scale, np.zeros(3)).pos.mean(axis=0)
    origin = np.round(middle) if np.abs(middle).max() > _FAR_OUT else np.zeros(3)
    exported = []
    for garment in plan.garments:
        one = object_named(garment.object, garment.uid)
        mesh = capture.garment_mesh(scene, plan.layer, one, scale, origin, garment.sew)
        exported.append(mesh)
        slots = meshes.part_names(garment.file, list(garment.slots))
        meshes.write_obj(plan.folder / command.GARMENTS / f"{garment.file}.obj", mesh, slots)
    _write_pins(plan, scene, exported)
    key_parts: list[Any] = [plan.first, plan.last, fps_of(scene), scale, origin.tolist(), plan.halves, plan.body]
    key_parts += [capture.movement_key(scene)]
    for frame in np.unique(np.linspace(plan.first, plan.last, _PROBES).round()):
        depsgraph = capture.evaluated(scene, plan.layer, float(frame))
        pose = capture.body_pose(depsgraph, object_named(plan.body, plan.body_uid), scale, origin)
        key_parts += [pose.pos, pose.faces if frame == plan.first else 0, *_matrices(plan, depsgraph)]
        yield 0.0
        scene = scene_named(plan.scene)
    key = state.digest(*key_parts)
    kept, archive = state.read_state(plan.folder), plan.folder / command.BODY
    matrices_file = archive.with_name("matrices.npy")
    if not plan.again and kept.get("capture") == key and is_body_file(archive) and matrices_file.is_file():
        progress.notes.append("the body has not changed, its capture is used again")
        samples = int(kept["samples"])
    else:
        matrices: list[list[np.ndarray]] = []
        sampled: list[int] = []
        yield from _follow_body(plan, progress, scale, origin, matrices, sampled)
        np.save(matrices_file, np.array(matrices).swapaxes(0, 1))
        samples = sampled[0]
        state.write_state(plan.folder, capture=key, samples=samples)
    found.append(Captured(exported, np.load(matrices_file), origin, samples, scale))


def _matrices(plan: Plan, depsgraph: Any) -> list[np.ndarray]:
    """(4, 4) into the world, of every garment."""
    garments = (object_named(garment.object, garment.uid) for garment in plan.garments)
    return [np.array(one.evaluated_get(depsgraph).matrix_world, np.float64) for one in garments]


def _pose(plan: Plan, moment: float, scale: float, origin: np.ndarray, first: capture.BodyPose | None) -> capture.BodyPose:
    """The body at a moment; refused where its mesh is not that of the ``first`` pose."""
    depsgraph = capture.evaluated(scene_named(plan.scene), plan.layer, moment)
    body = object_named(plan.body, plan.body_uid)
    pose = capture.body_pose(depsgraph, body, scale, origin)
    capture.check_same(body, first or pose, pose, moment)
    far = float(np.abs(pose.pos).max())
    if far > _FARTHEST:
        raise BakeError(
            f"body {plan.body}: is {far:.0f} m from where it was at first in frame {moment:g}; bake a range in which it stays "
            f"within {_FARTHEST:g} m"
        )
    return pose


def _follow_body(
    plan: Plan, progress: Progress, scale: float, origin: np.ndarray, matrices: list[list[np.ndarray]], sampled: list[int]
) -> Iterator[float]:
    """Capture every frame, then the moments between frames where the body is fast."""
    first = _pose(plan, plan.first, scale, origin, None)
    file = BodyFile(plan.folder / command.BODY, first.faces)
    try:
        for frame in range(plan.first, plan.last + 1):
            file.add(_pose(plan, frame, scale, origin, first).pos, FAR)
            view = scene_named(plan.scene).view_layers
            matrices.append(_matrices(plan, (view.get(plan.layer) or view[0]).depsgraph))
            progress.done = file.frames
            yield 0.0
        fast = list(file.fast) if plan.halves else []
        if fast:
            progress.work, progress.done, progress.total = "Capturing between fast frames", 0, len(fast)
        for after in fast:
            file.add_half(after, _pose(plan, plan.first + after + 0.5, scale, origin, first).pos)
            progress.done += 1
            yield 0.0
        sampled.append(file.finish(fps_of(scene_named(plan.scene))))
    finally:
        file.remove_parts()


def _write_pins(plan: Plan, scene: Any, exported: list[meshes.Exported]) -> None:
    """Pins of all garments; their numbers count through the outfit."""
    rows: list[dict[str, Any]] = []
    start = 0
    for garment, mesh in zip(plan.garments, exported, strict=True):
        if garment.pins:
            weights = np.zeros(len(mesh.pos))
            own = capture.weights_of(object_named(garment.object, garment.uid), garment.pins)
            there = mesh.number_of >= 0
            np.maximum.at(weights, mesh.number_of[there], own[there])
            held = np.flatnonzero(weights > 0.01)
            if not len(held):
                sentence = f"{garment.object}: no vertex of the group {garment.pins!r} has a weight; paint it"
                raise BakeError(sentence, garment.object)
            row: dict[str, Any] = {"vertices": (held + start).tolist(), "follows": "skin"}
            if (weights[held] < 0.999).any():
                row["weights"] = [round(float(weight), 4) for weight in weights[held]]
            if garment.follows:
                depsgraph = capture.evaluated(scene, plan.layer, plan.first)
                row["follows"] = capture.body_group(depsgraph, object_named(plan.body, plan.body_uid), garment.follows)
            rows.append(row)
        start += len(mesh.pos)
    (plan.folder / command.PINS).write_text(json.dumps(rows), encoding="utf-8")
