"""``hood rollout``: a garment, a body and a motion in; ``rollout.h5``, a video, a contact sheet and a summary out."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hood.app.batch.batch import (
    STATE,
    Job,
    as_begun,
    find_jobs,
    motion_attributes,
    refuse_others,
    resumed,
    share,
    with_one_stepper,
    write_overview,
)
from hood.app.common import output_folder, prepare_folder, together
from hood.app.notices import Bar, Heard, collected, heard, say, tell_how_far
from hood.app.output.export import (
    StreamedCaches,
    check_outputs,
    check_worn,
    export_beside,
    forms_beside,
    read_textures,
    remove_earlier,
)
from hood.app.output.frames import at_output_fps, finer_mesh, on_finer_mesh, planned_steps, refined_still, stored_body
from hood.app.output.summary import describe, describe_all, summarise
from hood.app.output.view import FilmAlongside, draw
from hood.app.plan_file import plan_mode, plan_path, plan_sentences, planned, rollout_config, summarise_plan, without_accuracy
from hood.app.progress import ProgressFile, RolloutProgress, find_progress, memories, recall
from hood.app.scene.events import describe_held, fastening_attributes, summarise_held
from hood.app.scene.fabrics import fabric_names
from hood.app.scene.garments import describe_ease, describe_pins, summarise_ease, summarise_pins
from hood.app.settings.compose import plain
from hood.app.settings.record import save_run_record
from hood.app.settings.rollout_settings import RolloutSettings, measurement
from hood.app.setup import Setup, check_config, make_stepper, set_up, solves_in_double, start_of
from hood.app.stepping.automatic import advice
from hood.app.stepping.cautions import idle_in_rollout, warn
from hood.app.stepping.cloth_contact import why_not
from hood.app.stepping.guarding import OFF, GuardStopped, guard_sentences, make_guard, write_alarms
from hood.app.stepping.refinement import exported
from hood.assets.files.atomic import occupy, write_atomically
from hood.rollouts.file.compact import BodyParameters, make_compact, store_of
from hood.rollouts.file.reader import RolloutData, read_rollout
from hood.rollouts.file.recorder import RolloutWriter, still_of
from hood.rollouts.frame import Ease, Frame, measure_ease, metric_names
from hood.rollouts.frames import ridden_faces, ridden_frames, ridden_rest, ridden_still, riding_attributes, still_needed
from hood.rollouts.loop import simulate
from hood.scene.sizing import Sizes
from hood.steppers.newton import Stepper, remembers
from hood.steppers.static_shapes.simulator import network_of
from hood.training import distributed


@dataclass(frozen=True)
class Rollouts:
    """What came of one rollout, or of one for each of many motions.

    Args:
        config: what was asked for.
        summaries: of every motion what its ``summary.json`` holds, or ``{"error": …}`` where it could not be used; one for
            one motion, none on processes of torchrun that had none.
        interrupted: by the user; the frames done are kept.
        notes: what was said meanwhile, a line each.
    """

    config: RolloutSettings
    summaries: tuple[dict[str, Any], ...]
    interrupted: bool
    notes: list[str]

    @property
    def folder(self) -> Path:
        """Where the files are."""
        return output_folder(self.config)

    @property
    def summary(self) -> dict[str, Any]:
        """Of the one motion, or the first."""
        return self.summaries[0] if self.summaries else {}


def rollout(overrides: Sequence[str], bar: Bar = tell_how_far) -> Rollouts:
    """Run what the words of ``hood rollout`` ask for.

    Args:
        bar: shows how far simulations and films are.

    Raises:
        ConfigError, ValueError, OSError: words or files that cannot be used.
        hood.app.common.GivenUpError: on another process of torchrun.
    """
    with collected() as notes:
        config, summaries, interrupted = _rollout(overrides, bar)
    return Rollouts(config, tuple(summaries), interrupted, notes)


_Made = tuple[RolloutSettings, list[dict[str, Any]], bool]


def _rollout(overrides: Sequence[str], bar: Bar) -> _Made:
    config = rollout_config(without_accuracy(overrides))
    check_config(config)
    check_outputs(config)
    if distributed.is_first():
        _tell(idle_in_rollout(overrides, config))
    return together(lambda: _run(rollout_config(distributed.on_main(lambda: planned(overrides))), bar))


def _run(config: RolloutSettings, bar: Bar) -> _Made:
    """One motion, or each of many in a folder of its own; processes that torchrun started share the many."""
    output = output_folder(config)
    jobs = distributed.on_main(lambda: find_jobs(str(config.sequence), output, config.root))
    if jobs is not None:
        return _run_all(config, jobs, output, bar)
    if distributed.rank() != 0:
        return config, [], False
    config = as_begun(config, [(str(config.sequence), output)])
    stepper, digest = make_stepper(config)
    summary, interrupted = resumed(config, digest), False
    if summary is None:
        summary, interrupted = _run_one(config, stepper, digest, bar)
    else:
        say(f"resume=true: {output} holds this rollout, finished with the same settings; it stays")
    return config, [summary], interrupted


def _run_one(
    config: RolloutSettings, stepper: Stepper, digest: str, bar: Bar, alone: bool = True
) -> tuple[dict[str, Any], bool]:
    """The rollout of one motion with all its files: the summary, and whether the user interrupted it. Where many are run
    none may replace another's, and none is the place for advice on the stepper."""
    with heard() as warned:
        return _run_heard(config, stepper, digest, warned, bar, alone, output_folder(config))


def roll_out_into(config: RolloutSettings, stepper: Stepper, digest: str, bar: Bar, folder: Path) -> dict[str, Any]:
    """The rollout of one motion with all its files, written into another folder than ``config.output``, where the caller puts
    it; returns the summary.

    Raises:
        ConfigError, ValueError, OSError: settings or files that cannot be used.
        KeyboardInterrupt: the user interrupted it; frames done may be there.
    """
    with heard() as warned:
        summary, interrupted = _run_heard(config, stepper, digest, warned, bar, False, folder)
    if interrupted:
        raise KeyboardInterrupt
    return summary


def _tell(sentences: Sequence[str]) -> None:
    for sentence in sentences:
        say(sentence)


def _keep_plan(config: RolloutSettings, folder: Path) -> None:
    """The plan beside what was made by it: the rollout can be made again when the plan's own place is gone."""
    path, here = plan_path(config), folder / "plan.json"
    if path is not None and path.resolve() != here.resolve():
        write_atomically(here, path.read_bytes())


def _run_heard(
    config: RolloutSettings, stepper: Stepper, digest: str, warned: Heard, bar: Bar, alone: bool, folder: Path
) -> tuple[dict[str, Any], bool]:
    """The rollout of one motion; ``warned`` is what has been warned about when the summary is written."""
    ready = set_up(config, stepper)
    check_worn(read_textures(config), ready.scene.garment)
    body = stored_body(ready.config, ready.scene)
    with occupy(prepare_folder(folder)):
        if not alone:
            refuse_others(folder, str(config.sequence))
        return _run_there(ready, config, digest, warned, bar, alone, folder, body)


def _run_there(
    ready: Setup,
    asked: RolloutSettings,
    digest: str,
    warned: Heard,
    bar: Bar,
    advise: bool,
    folder: Path,
    body: BodyParameters | None,
) -> tuple[dict[str, Any], bool]:
    """The rollout in its folder, which is there and held; ``body`` gives the body back where it is not stored."""
    config = ready.config
    scene, stepper = ready.scene, ready.stepper
    begun = find_progress(folder, asked, digest, scene, stepper) if bool(asked.resume) else None
    remove_earlier(folder, config, goes_on=begun is not None)
    save_run_record(folder, config, int(config.seed))
    eases: list[Ease | None] = [] if begun is None else list(begun.eases)
    warned += [] if begun is None else [sentence for sentence in begun.warnings if sentence not in warned]
    kept = ProgressFile(folder, scene, stepper)
    caches = StreamedCaches(folder / "rollout.h5", forms_beside(config), read_textures(config))
    exported: Sequence[str] = []
    path, count = folder / "rollout.h5", min(int(config.num_frames), scene.num_frames)
    with closing(FilmAlongside(config, scene.motion, 0 if begun is not None else count, folder)) as film:
        with closing(caches):
            interrupted = _simulate_to_disk(ready, digest, path, asked, eases, warned, bar, caches, film, kept, begun)
        data = read_rollout(path)
        if not interrupted:
            make_compact(path, store_of(config.formats), body)
        try:
            with ThreadPoolExecutor(1) as beside:  # it is judged while it is drawn
                judged = beside.submit(summarise, data)
                if not interrupted:
                    if not film.finish(bar):
                        draw(config, data, folder, bar)
                    exported = export_beside(path, forms_beside(config), read_textures(config), caches)
        finally:
            summary = _conclude(ready, folder, data, judged.result(), eases, advise)
            summary["warnings"] = list(warned)
            _write_json(folder / "summary.json", summary)
    if not interrupted:
        kept.remove()
    _tell(exported)
    say(f"files in {folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}")
    if interrupted:
        there = f"the {summary['num_frames']} frames done are kept in {folder / 'rollout.h5'}"
        on = "; the same command with resume=true goes on" if (folder / STATE).exists() else ""
        say(f"hood: interrupted; {there}{on}", error=True)
    return summary, interrupted


def _conclude(
    ready: Setup, folder: Path, data: RolloutData, summary: dict[str, Any], eases: list[Ease | None], advise: bool
) -> dict[str, Any]:
    """What there is to say of a rollout that is there; returns all of it for ``summary.json``."""
    config, scene, simulator = ready.config, ready.scene, network_of(ready.stepper)
    if eases:
        summary |= summarise_ease(eases[0], eases[-1])
    if scene.holding is not None:
        summary |= summarise_held(scene, data)
    summary |= summarise_pins(scene, data)
    warn(guard_sentences(summary.get("guard")))
    summary["choice"] = asdict(ready.choice)
    summary |= summarise_plan(folder / "rollout.h5", config)
    _keep_plan(config, folder)
    say(describe(summary))
    _tell([*describe_pins(summary), *describe_held(summary)])
    _tell(describe_ease(summary))
    _tell(plan_sentences(summary))
    if advise:
        _tell(advice(config, scene, summary, data.cloth_pos[0, : scene.cloth.num_vertices].astype(np.float64)))
    summary["kernels"] = None if simulator is None else simulator.network.kernels
    return summary


def _run_all(config: RolloutSettings, jobs: list[Job], output: Path, bar: Bar) -> _Made:
    """Every motion in its folder, and ``summary.json`` over all of them; one stepper for all."""
    config = distributed.on_main(lambda: with_one_stepper(config, jobs))
    stepper, digest = make_stepper(config)

    def work(job: Job) -> tuple[dict[str, Any], bool]:
        one = job.of(config)
        done = resumed(one, digest)
        return (done | {"skipped": True}, False) if done is not None else _run_one(one, stepper, digest, bar, alone=False)

    outcome = share(jobs, work)
    if distributed.rank() == 0:
        overview = write_overview(prepare_folder(output), outcome.rows, {job.sequence: job.folder for job in jobs})
        say(describe_all(outcome.rows, len(jobs)))
        say(f"summary of all in {overview}")
        if len(outcome.rows) < len(jobs):
            say("hood: not all done; the same command with resume=true goes on", error=True)
    if outcome.hopeless is not None:
        raise outcome.hopeless
    return config, list(outcome.rows.values()), outcome.interrupted


def _simulate_to_disk(
    ready: Setup,
    digest: str,
    path: Path,
    asked: RolloutSettings,
    eases: list[Ease | None],
    warned: Heard,
    bar: Bar,
    caches: StreamedCaches,
    film: FilmAlongside,
    kept: ProgressFile,
    begun: RolloutProgress | None,
) -> bool:
    """Stream the rollout into ``path`` and ``caches``, and into ``kept`` where it is; the ``film`` is told of every frame. True
    when the user interrupted it. What was ``begun`` goes on. ``asked`` is the config with ``auto`` in it, ``warned`` holds the
    doubts about its inputs. Where a size was asked for, how the garment sat is added to ``eases``, at the beginning and the
    end."""
    config, scene, stepper, potential = ready.config, ready.scene, ready.stepper, ready.potential
    guard = make_guard(config, stepper, potential)
    if begun is not None:
        recall(begun, path.parent, guard)
    measured, (settle, relaxing) = measurement(config), start_of(config)
    count = min(int(config.num_frames), scene.num_frames)
    if count < int(config.num_frames):
        say(f"{scene.motion.name} has {count} frames at {1 / scene.dt:g} fps; the rollout ends there")
    attributes = {
        "material": plain(config.material),
        "config": plain(config),
        "asked": plain(asked),
        "checkpoint": str(config.checkpoint),
        "checkpoint_sha256": digest,
        "model": stepper.config,
        "stepper": str(config.stepper),
        "garment": scene.garment.name,
        "sequence": scene.motion.name,
        "surface_stride": measured.surface_every,
        "cloth_contact_off": why_not(config),
        "guard": OFF if guard is None else guard.mode,
        "doubts": [doubt.as_dict() for doubt in warned.doubts],
        **motion_attributes(str(config.sequence)),
        **fastening_attributes(scene),
    }
    steps, finer = planned_steps(config, scene, count), finer_mesh(config, scene)
    if finer is not None:
        attributes |= {"refine_mesh": int(config.refine_mesh), "simulated_vertices": finer.num_coarse}
    garment, riders = scene.garment, scene.garment.riders
    attributes |= riding_attributes(riders)
    names, fabric = fabric_names(config, garment, scene.motion)
    attributes["fabric_names"] = "+".join(names)
    still = still_of(garment, scene.fastening, scene.cloth) | ({"fabric": fabric} if len(names) > 1 else {})
    still = refined_still(still, finer, garment.faces)
    stored_rest = scene.cloth.rest_pos.cpu().numpy() if finer is None else finer.rest_pos
    writer = RolloutWriter(
        path,
        count if steps is None else steps.rate.count(count),
        ridden_rest(stored_rest, garment),
        ridden_faces(garment.faces if finer is None else finer.faces, len(stored_rest), riders),
        scene.motion.faces,
        scene.motion.num_vertices,
        metric_names(potential, stepper, measured.kind, settle, guard is not None),
        scene.dt if steps is None else 1.0 / steps.rate.fps,
        attributes,
        farthest=float(np.abs(scene.motion.translation).max()),
        fields=exported(config),
        double=solves_in_double(config),
        guarded=guard is not None,
        still=ridden_still(still, riders),
        steps=steps,
        done=None if begun is None else begun.done,
        goes_on=not remembers(stepper),
    )
    frames = simulate(
        stepper,
        scene,
        potential,
        count,
        relaxing,
        metrics=measured.kind,
        fields=exported(config),
        surface_stride=measured.surface_every,
        settle=settle,
        guard=guard,
        afresh=plan_mode(config) == "full",
        after=None if begun is None else begun.frame,
        goal=None if begun is None else begun.goal,
    )
    given, known = (0, ()) if begun is None else (begun.done.frames, begun.known)
    left = count if begun is None else count - 1 - begun.frame.index

    def simulated() -> Iterator[Frame]:
        """The simulated frames, each noted before it is passed on."""
        recent = list(known)
        for frame in bar(frames, left, f"rollout {scene.garment.name}"):
            if steps is not None:
                writer.append_step(frame.world_pos.numpy(), frame.metrics)
            if scene.sizes != Sizes() and frame.index in (0, count - 1):
                eases.append(measure_ease(scene, scene.cloth_at(frame.index), frame.state, frame.index))
            yield frame
            write_alarms(writer, guard)
            recent = [] if steps is None else still_needed([*recent, frame], steps.rate, writer.frames_done)
            kept.keep(RolloutProgress(frame, writer.done, recent, *memories(guard, stepper), tuple(eases), tuple(warned)))

    try:
        with writer:
            shown = on_finer_mesh(at_output_fps(simulated(), config, scene, count, given=given, known=known), finer, scene)
            for frame in ridden_frames(shown, garment):
                fields = {name: values.numpy() for name, values in frame.fields.items()}
                writer.append(frame.world_pos.numpy(), frame.body_pos.numpy(), frame.metrics, fields)
                caches.append(frame.world_pos.numpy(), frame.body_pos.numpy())
                film.tell()
            write_alarms(writer, guard)
            if guard is not None and guard.stopped is not None:
                raise GuardStopped
    except GuardStopped:
        return False
    except KeyboardInterrupt:
        if writer.frames_done == 0:
            raise
        kept.write_last()
        return True
    except OSError:
        if kept.write_last():
            say(f"hood: {writer.frames_done} frames are kept in {path}; the same command with resume=true goes on", error=True)
        raise
    return False


def _write_json(path: Path, value: dict[str, Any]) -> None:
    temporary = path.with_name(path.name + ".partial")
    temporary.write_text(json.dumps(value, indent=1), encoding="utf-8")
    os.replace(temporary, path)
