"""``hood rollout``: a garment, a body and a motion in; ``rollout.h5``, a video, a contact sheet and a summary out."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from hood.assets.library import locate
from hood.assets.occupied import occupy
from hood.commands.automatic import advice, choose
from hood.commands.batch import Job, find_jobs, share
from hood.commands.cautions import scene_cautions, warn
from hood.commands.cloth_contact import check_cloth_contact, potential_of, tell_if_off, why_not
from hood.commands.common import (
    UNTRAINED,
    output_folder,
    prepare_folder,
    read_model,
    require_device,
    require_same_model,
    thinning,
    together,
    use_arithmetic,
    weigh,
)
from hood.commands.dial import AUTO, check_dial, chosen, exported, refined
from hood.commands.guarding import OFF, GuardStopped, check_guard, guard_sentences, make_guard, write_alarms
from hood.commands.notices import heard
from hood.commands.performance import make_motion
from hood.commands.summary import describe, describe_all, summarise
from hood.commands.verdict import exit_code
from hood.commands.wardrobe import heed, layer_order, names_of, read_outfit
from hood.config import ConfigError, build, load_config, plain, require_choice, save_run_record
from hood.dynamics.captured import MODES, CapturedSimulator, network_of
from hood.dynamics.captured_newton import CapturedNewton
from hood.dynamics.recorder import RolloutWriter, read_rollout
from hood.dynamics.refine import GuessStepper
from hood.dynamics.rollout import METRIC_CHOICES, SETTLE_CHOICES, metric_names, own_start, simulate
from hood.dynamics.simulator import Simulator
from hood.dynamics.stepper import NewtonStepper, Stepper
from hood.nn.compiled import KERNELS
from hood.scene.fitting import doubts, misplacement
from hood.scene.scene import Scene, dress
from hood.training import distributed

#: ``step=plain``: shapes as the step needs them, the readable reference.
PLAIN = "plain"


def run(overrides: Sequence[str]) -> int:
    """Run the command; returns the exit code: 130 where the user interrupted it, else 2 where a motion of many could not be
    used, else 3 where a result is unsound (:mod:`hood.dynamics.soundness`), else 0."""
    config = load_config("rollout", overrides)
    require_device(config)
    require_choice(config, "video", ("mp4", "gif", "none"))
    require_choice(config, "metrics", METRIC_CHOICES)
    require_choice(config, "settle", SETTLE_CHOICES)
    _check_numbers(config)
    require_choice(config, "kernels", (AUTO, *KERNELS))
    require_choice(config, "stepper", ("network", "newton", "refine", AUTO))
    require_choice(config, "step", (PLAIN, *MODES))
    check_dial(config)
    check_guard(config)
    check_cloth_contact(config)
    return together(lambda: _run(config))


def _run(config: DictConfig) -> int:
    """One motion, or each of many in a folder of its own; processes that torchrun started share the many."""
    output = output_folder(config)
    jobs = distributed.on_main(lambda: find_jobs(str(config.sequence), output))
    if jobs is not None:
        return _run_all(config, jobs, output)
    if distributed.rank() != 0:
        return 0
    summary, interrupted = _run_one(config, *make_stepper(config))
    return 130 if interrupted else exit_code([summary], bool(config.allow_unsound))


def _run_one(config: DictConfig, stepper: Stepper, digest: str, advise: bool = True) -> tuple[dict[str, Any], bool]:
    """The rollout of one motion with all its files: the summary, and whether the user interrupted it. Where many are run,
    none is the place for advice on the stepper."""
    with heard() as warned:
        return _run_heard(config, stepper, digest, warned, advise)


def _tell(sentences: Sequence[str]) -> None:
    for sentence in sentences:
        print(sentence)


def _first_positions(path: Path) -> np.ndarray:
    """Frame 0 of a rollout file, (V, 3) float64 [m], world."""
    with h5py.File(path, "r") as file:
        return np.asarray(file["cloth/pos"][0], dtype=np.float64)


def _run_heard(
    config: DictConfig, stepper: Stepper, digest: str, warned: list[str], advise: bool
) -> tuple[dict[str, Any], bool]:
    """The rollout of one motion; ``warned`` is what has been warned about when the summary is written."""
    asked, scene = config, make_scene(config)
    choice = choose(asked, stepper, scene)
    config = choice.settle(asked)
    _tell(choice.why)
    if _solves_in_double(config) != _solves_in_double(asked):
        scene = make_scene(config)
    if choice.stepper == "newton" and network_of(stepper) is not None:
        stepper, _ = make_stepper(config)
    stepper = refined(stepper, config, scene.cloth.num_vertices, potential_of(config))
    _check_start(config, stepper, scene)
    tell_if_off(config, 1 if scene.outfit is None else len(scene.outfit.names))
    warn(scene_cautions(stepper, scene, build(config.losses), str(config.checkpoint)))
    with occupy(prepare_folder(output_folder(config))):
        return _run_there(config, asked, scene, stepper, digest, asdict(choice), warned, advise)


def _run_there(
    config: DictConfig,
    asked: DictConfig,
    scene: Scene,
    stepper: Stepper,
    digest: str,
    choice: dict[str, Any],
    warned: list[str],
    advise: bool,
) -> tuple[dict[str, Any], bool]:
    """The rollout in its folder, which is there and held."""
    folder = output_folder(config)
    (folder / "summary.json").unlink(missing_ok=True)  # its presence says that everything is there
    save_run_record(folder, config, int(config.seed))
    interrupted = _simulate_to_disk(config, scene, stepper, digest, folder / "rollout.h5", asked)
    summary = summarise(folder / "rollout.h5")
    warn(guard_sentences(summary.get("guard")))
    summary["choice"] = choice
    print(describe(summary))
    if advise:
        _tell(advice(config, scene, summary, _first_positions(folder / "rollout.h5")))
    simulator = network_of(stepper)
    try:
        if not interrupted:
            _draw(config, folder)
    finally:
        summary["kernels"] = None if simulator is None else simulator.network.kernels
        summary["warnings"] = list(warned)
        _write_json(folder / "summary.json", summary)
    print(f"files in {folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}")
    if interrupted:
        print(
            f"hood: interrupted; the {summary['num_frames']} frames done are kept in {folder / 'rollout.h5'}",
            file=sys.stderr,
        )
    return summary, interrupted


def _run_all(config: DictConfig, jobs: list[Job], output: Path) -> int:
    """Every motion in its folder, and ``summary.json`` over all of them."""
    stepper, digest = make_stepper(config)

    def work(job: Job) -> tuple[dict[str, Any], bool]:
        one = OmegaConf.merge(config, {"sequence": job.sequence, "output": str(job.folder)})
        assert isinstance(one, DictConfig)
        done = _finished(one, digest, job.folder) if bool(config.resume) else None
        return (done, False) if done is not None else _run_one(one, stepper, digest, advise=False)

    outcome = share(jobs, work)
    if distributed.rank() == 0:
        prepare_folder(output)
        _write_json(output / "summary.json", {"num_motions": len(jobs), "motions": outcome.rows})
        print(describe_all(outcome.rows, len(jobs)))
        print(f"summary of all in {output / 'summary.json'}")
        if len(outcome.rows) < len(jobs):
            print("hood: not all done; the same command with resume=true goes on", file=sys.stderr)
    if outcome.hopeless is not None:
        raise outcome.hopeless
    if outcome.interrupted:
        return 130
    if any("error" in row for row in outcome.rows.values()):
        return 2
    return exit_code(outcome.rows.values(), bool(config.allow_unsound))


def _finished(config: DictConfig, digest: str, folder: Path) -> dict[str, Any] | None:
    """The summary of a rollout that was finished with the same settings and weights; None where there is none."""
    try:
        summary: dict[str, Any] = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        with h5py.File(folder / "rollout.h5", "r") as file:
            attributes = dict(file.attrs)
        before = json.loads(attributes["asked"])
    except (OSError, ValueError, KeyError):
        return None
    now = plain(config)
    same = all(before.get(key) == now[key] for key in now if key not in ("resume", "output", "allow_unsound"))
    if not same or not bool(attributes["complete"]) or attributes["checkpoint_sha256"] != digest:
        return None
    return summary if "sound" in summary else summarise(folder / "rollout.h5")


def make_scene(config: DictConfig) -> Scene:
    """Assets named in the config, put together."""
    motion = make_motion(config, torch.float64 if _solves_in_double(config) else torch.float32)
    order = layer_order(config.layers, names_of(config.garment))
    garment = read_outfit(config.garment, motion, bool(config.triangulate), config.pins)
    scene = replace(dress(garment, motion, build(config.material)), layers=order)
    found = misplacement(scene)
    if found is not None and found.grave:
        raise ValueError(
            f"garment {garment.name!r}: not worn by {motion.name!r} in its first frame: it {found.what}; give it as it is worn "
            f"there, {found.fix}"
        )
    heed(garment.name, [found] if found is not None else [])
    for name, doubt in doubts(scene):
        heed(name, [doubt])
    return scene


def _solves_in_double(config: DictConfig) -> bool:
    """Whether steps are judged in float64: then states are kept in it, rounded ones would not meet what is said of them."""
    return bool(config.solver.double) and (str(config.stepper) not in ("network", AUTO) or chosen(config) is not None)


def make_stepper(config: DictConfig) -> tuple[Stepper, str]:
    """What takes the steps, before they are refined, and the SHA-256 of its weights (``none`` without a network)."""
    if str(config.stepper) in ("network", AUTO):
        simulator, digest = make_simulator(config)
        weigh(simulator, config)
        use_arithmetic(simulator, config, traced=str(config.step) == "compiled")
        stepper: Stepper = simulator if str(config.step) == PLAIN else CapturedSimulator(simulator, str(config.step))
        return stepper, digest
    potential = potential_of(config)
    kind = GuessStepper if str(config.stepper) == "refine" else NewtonStepper
    solver = kind(potential, build(config.solver))
    weigh(solver, config)
    if str(config.step) == PLAIN:
        return solver, "none"
    if not isinstance(solver, NewtonStepper):
        raise ConfigError(f"step={config.step}: steps of stepper={config.stepper} are plain; drop step=… from the command")
    return CapturedNewton(solver, str(config.step)), "none"


def make_simulator(config: DictConfig) -> tuple[Simulator, str]:
    """The checkpoint's simulator and its SHA-256; ``checkpoint=untrained`` builds ``model`` with seeded random weights.

    Raises:
        ConfigError: the checkpoint holds another model than the one asked for.
    """
    torch.manual_seed(int(config.seed))
    asked = None if config.get("model") is None else plain(config.model)
    device = str(config.device)
    if str(config.checkpoint) == UNTRAINED:
        if asked is None:
            raise ConfigError("checkpoint=untrained needs a model: add model=small (or ours, fine15, fine48)")
        simulator: Simulator = build(config.model)
        return simulator.eval().to(device), UNTRAINED
    path = locate("weights", str(config.checkpoint))
    simulator = read_model(path, float(config.fps))
    if asked is not None:
        require_same_model(path, simulator, build(config.model), "drop model=… from the command")
    return simulator.eval().to(device), hashlib.sha256(path.read_bytes()).hexdigest()


def _simulate_to_disk(config: DictConfig, scene: Scene, stepper: Stepper, digest: str, path: Path, asked: DictConfig) -> bool:
    """Stream the rollout into ``path``; True when the user interrupted it. ``asked`` is the config with ``auto`` in it."""
    potential = potential_of(config)
    guard = make_guard(config, stepper, potential)
    count = min(int(config.num_frames), scene.num_frames)
    if count < int(config.num_frames):
        print(f"{scene.motion.name} has {count} frames at {1 / scene.dt:g} fps; the rollout ends there")
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
        "surface_stride": int(config.surface_stride),
        "cloth_contact_off": why_not(config),
        "guard": OFF if guard is None else guard.mode,
    }
    writer = RolloutWriter(
        path,
        count,
        scene.cloth.rest_pos.cpu().numpy(),
        scene.garment.faces,
        scene.motion.faces,
        scene.motion.num_vertices,
        metric_names(potential, stepper, str(config.metrics), str(config.settle), guard is not None),
        scene.dt,
        attributes,
        farthest=float(np.abs(scene.motion.translation).max()),
        fields=exported(config),
        double=_solves_in_double(config),
        guarded=guard is not None,
    )
    frames = simulate(
        stepper,
        scene,
        potential,
        count,
        int(config.relaxing_steps),
        metrics=str(config.metrics),
        fields=exported(config),
        surface_stride=int(config.surface_stride),
        settle=str(config.settle),
        guard=guard,
    )
    try:
        with writer:
            for frame in tqdm(frames, total=count, desc=f"rollout {scene.garment.name}", unit="frame", disable=_quiet()):
                fields = {name: values.numpy() for name, values in frame.fields.items()}
                writer.append(frame.world_pos.numpy(), frame.body_pos.numpy(), frame.metrics, fields)
                write_alarms(writer, guard)
            write_alarms(writer, guard)
            if guard is not None and guard.stopped is not None:
                raise GuardStopped
    except GuardStopped:
        return False
    except KeyboardInterrupt:
        if writer.frames_done == 0:
            raise
        return True
    return False


def _check_start(config: DictConfig, stepper: Stepper, scene: Scene) -> None:
    """A line where a rollout has a start of its own; ConfigError where the number of relaxing steps would play no role."""
    if str(config.settle) != "equilibrium":
        return
    reason = own_start(stepper, scene)
    if reason is not None:
        print(f"settle=paper: {reason}")
    elif int(config.relaxing_steps) != 1:
        raise ConfigError(
            f"relaxing_steps={config.relaxing_steps}: belongs to settle=paper, settle=equilibrium has none; add settle=paper"
        )


def _draw(config: DictConfig, folder: Path) -> None:
    """Contact sheet and video, when the picture libraries are installed."""
    if str(config.video) == "none" and not bool(config.sheet):
        return
    try:
        from hood.media.film import write_sheet, write_video
    except ImportError as error:
        print(f"no pictures: {error}", file=sys.stderr)
        return
    data, colour, thinner = read_rollout(folder / "rollout.h5"), str(config.colour), thinning(config)
    if bool(config.sheet):
        write_sheet(data, folder / "contact_sheet.png", colour, thinner)
    if str(config.video) != "none":
        frames = tqdm(range(0, len(data.cloth_pos), int(config.video_stride)), desc="video", unit="frame", disable=_quiet())
        write_video(data, folder / f"rollout.{config.video}", frames, int(config.video_stride), colour, thinner)


def _check_numbers(config: DictConfig) -> None:
    for key, least in (("num_frames", 1), ("relaxing_steps", 0), ("video_stride", 1), ("surface_stride", 1), ("seed", 0)):
        if int(config[key]) < least:
            raise ConfigError(f"{key}={config[key]}: must be at least {least}")
    thinning(config)
    if not 1.0 <= float(config.fps) <= 1000.0:
        raise ConfigError(f"fps={config.fps}: give the simulation's frames per second, 1 to 1000")
    if not 0.0 <= float(config.gravity) <= 1000.0:
        raise ConfigError(f"gravity={config.gravity}: give m/s², downwards, 0 to 1000")


def _write_json(path: Path, value: dict[str, Any]) -> None:
    temporary = path.with_name(path.name + ".partial")
    temporary.write_text(json.dumps(value, indent=1), encoding="utf-8")
    os.replace(temporary, path)


def _quiet() -> bool | None:
    """For progress bars: shown on a terminal, by one process."""
    return True if distributed.rank() else None
