"""A bake: capture, run, collect. Generators do a small piece of work at a time, so that Blender stays usable."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from . import command, fault, finding, meshes, process, state
from .axes import gravity_of, wind_of
from .capturing import capture_all
from .collector import Collector
from .fault import BakeError, Fault
from .lookup import fps_of, scale_of, scene_named
from .plan import Captured, Plan, Progress

#: Programs whose version was asked for in this session.
_KNOWN: set[tuple[Any, ...]] = set()
#: Seconds between two looks at the process.
_WAIT = 0.25
#: Seconds that hood has to end in when it is asked to.
_PATIENCE = 15.0


def bake(plan: Plan, progress: Progress) -> Iterator[float]:
    """Do all of it; yields how long nothing has to be done [s].

    Raises:
        BakeError: it cannot go on; frames that are there stay.
    """
    yield from _check_hood(plan, progress)
    plan.folder.mkdir(parents=True, exist_ok=True)
    captured: list[Captured] = []
    yield from capture_all(plan, progress, captured)
    yield from _run(plan, progress, captured[0])


def _check_hood(plan: Plan, progress: Progress) -> Iterator[float]:
    """See that hood is there and new enough."""
    known = (*plan.hood, os.path.getmtime(plan.hood[0]))
    if known in _KNOWN:
        return
    progress.work = "Looking for hood"
    plan.folder.mkdir(parents=True, exist_ok=True)
    log = plan.folder / "version.txt"
    try:
        asked = process.Process([*plan.hood, "--version"], plan.folder, log)
    except OSError as error:
        raise BakeError(
            f"{plan.hood[0]}: cannot be started ({error.strerror}); name hood in the add-on's preferences"
        ) from error
    try:
        while asked.code is None:
            yield 0.05
    finally:
        asked.kill()
    finding.check_version(asked.said(), plan.hood[0])
    _KNOWN.add(known)


def request_of(plan: Plan, scene: Any, captured: Captured) -> command.Request:
    """What hood is asked for."""
    scale = scale_of(scene)
    winds = [one for one in scene.objects if one.field is not None and one.field.type == "WIND"]
    fields = [(np.array(one.matrix_world.to_3x3().col[2].normalized()), float(one.field.strength)) for one in winds]
    garments = []
    for garment, mesh in zip(plan.garments, captured.exported, strict=True):
        parts = list(zip(meshes.part_names(garment.file, list(garment.slots)), garment.slots, strict=True))
        used = tuple(part for number, part in enumerate(parts) if (mesh.part == number).any())
        garments.append(command.Garment(garment.file, garment.fabric, used))
    try:
        gravity = gravity_of(tuple(scene.gravity), scene.use_gravity, scale)
    except ValueError as error:
        raise BakeError(str(error)) from error
    return command.Request(
        tuple(garments),
        plan.last - plan.first + 1,
        fps_of(scene),
        captured.samples,
        gravity,
        wind_of(fields, scale),
        plan.quality,
        any(garment.pins for garment in plan.garments),
        plan.more,
    )


def _run(plan: Plan, progress: Progress, captured: Captured) -> Iterator[float]:
    """Run hood on what was captured; its frames come into the caches as it writes them."""
    scene = scene_named(plan.scene)
    words = command.words_of(request_of(plan, scene, captured))
    files = [command.BODY, command.PINS, *(f"{command.GARMENTS}/{garment.file}.obj" for garment in plan.garments)]
    key = state.run_key(plan.folder, words, files)
    kept = state.read_state(plan.folder)
    if kept.get("run") != key:  # files of the same name with another content: hood cannot know
        shutil.rmtree(plan.folder / command.RUN, ignore_errors=True)
        state.write_state(plan.folder, run=key, samples_there=0)
    collector = Collector(plan, captured, kept.get("samples_there", 0) if kept.get("run") == key else 0)
    progress.work, progress.done, progress.total = "Starting hood", 0, plan.last - plan.first + 1
    running = process.Process([*plan.hood, *words], plan.folder, plan.folder / "log.txt", plan.threads)
    progress.runs = True
    try:
        yield from _watch(progress, running, collector)
        collector.collect_all()
    finally:
        progress.runs = False
        if running.code is None:  # Blender ends, or the collector has failed
            running.interrupt()
            _end(running)
        state.write_state(plan.folder, samples_there=collector.samples)
    if not progress.cancel:
        _judge(plan, progress, running, collector)


def _watch(progress: Progress, running: process.Process, collector: Collector) -> Iterator[float]:
    """Bring frames and tell how far hood is until it ends; where the user cancels, it ends with the frame that it is at."""
    began, first, until = time.monotonic(), None, 0.0
    while running.code is None:
        progress.done = max(progress.done, collector.collect())
        said, now = process.how_far(running.said()), time.monotonic()
        if progress.cancel and not until:
            progress.work, progress.left, until = "Stopping", "", now + _PATIENCE
            running.interrupt()
        elif progress.cancel and now > until:
            running.kill()
        elif collector.samples and not progress.cancel:
            first = first or (collector.samples, now)
            progress.work, progress.done, progress.total = "Simulating", collector.samples, collector.total
            progress.left = process.time_left(collector.samples - first[0], collector.total - first[0], now - first[1])
        elif said is not None and not progress.cancel:
            progress.work, progress.done, progress.total = said[0].capitalize(), said[1], said[2]
            progress.left = process.time_left(said[1], said[2], now - began)
        yield _WAIT


def _end(running: process.Process) -> None:
    """Wait until an interrupted process has ended, then end it."""
    until = time.monotonic() + _PATIENCE
    while running.code is None and time.monotonic() < until:
        time.sleep(0.05)
    running.kill()


def _judge(plan: Plan, progress: Progress, running: process.Process, collector: Collector) -> None:
    """Read what came of it: faults into the list, an error as an error."""
    names, code = [garment.file for garment in plan.garments], running.code
    progress.done, progress.left = collector.samples, ""
    summary = plan.folder / command.RUN / "summary.json"
    progress.faults = [_in_blender(plan, collector, one) for one in fault.faults_in(summary, names)]
    if code not in (0, 3):
        said = fault.error_of(running.said())
        if code is not None and code < 0:
            said = f"hood was ended by signal {-code} after {collector.samples} frames, which stay; bake again to go on"
        one = _in_blender(plan, collector, fault.fault_of(said, names))
        progress.faults.insert(0, one)
        raise BakeError(said or f"hood ended with code {code} and said nothing; see {plan.folder / 'log.txt'}")
    if collector.samples == 0:
        raise BakeError(f"hood wrote no cache into {plan.folder / command.RUN}; see {plan.folder / 'log.txt'}")
    progress.seconds_per_frame = _seconds_per_frame(summary, collector.captured.samples)
    if plan.keys and not plan.estimate:
        collector.key_shapes()
    progress.work = "Finished" if code == 0 else "Finished, with faults"


def _seconds_per_frame(summary: Path, samples: int) -> float:
    """Of a frame of the scene, by hood's own clock."""
    try:
        content = json.loads(summary.read_text(encoding="utf-8"))
        return float(content["ms_per_frame"]["total"]["median"]) * samples / 1000.0
    except (OSError, ValueError, KeyError, TypeError):
        return 0.0


def _in_blender(plan: Plan, collector: Collector, one: Fault) -> Fault:
    """A fault with the numbers of Blender's vertices and polygons, and the object's name."""
    files = [garment.file for garment in plan.garments]
    exported = collector.captured.exported
    starts = np.cumsum([0, *(len(mesh.pos) for mesh in exported)]).tolist()
    face_starts = np.cumsum([0, *(len(mesh.faces) for mesh in exported)]).tolist()
    if one.garment in files:
        place = files.index(one.garment)
        vertices, faces = one.vertices, one.faces
    else:  # numbers count through the outfit
        first = one.vertices[0] if one.vertices else None
        place = next((k for k in range(len(files)) if first is not None and first < starts[k + 1]), 0)
        place = next((k for k in range(len(files)) if one.faces and one.faces[0] < face_starts[k + 1]), place)
        vertices = fault.own_numbers(one.vertices, starts[place], len(exported[place].pos))
        faces = fault.own_numbers(one.faces, face_starts[place], len(exported[place].faces))
    mesh = exported[place]
    frame = None if one.frame is None else one.frame // collector.captured.samples
    return Fault(one.text, plan.garments[place].object, frame, mesh.originals(vertices), mesh.polygons(faces), one.repair)
