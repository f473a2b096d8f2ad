"""``resume=true``: where a rollout that was stopped is, kept beside it in ``rollout.state`` while it runs.

A rollout goes on after its last whole frame, and comes to what it would have come to undisturbed.
"""

from __future__ import annotations

import hashlib
import io
import json
import time
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from torch import Tensor

from hood import __version__
from hood.app.batch.batch import STATE, attributes_of, other_settings
from hood.app.notices import say
from hood.app.settings.compose import brief
from hood.app.settings.rollout_settings import RolloutSettings
from hood.assets.files.atomic import write_atomically
from hood.cloth.state import State
from hood.rollouts.checks.guard import Guard
from hood.rollouts.file.reader import alarms_in
from hood.rollouts.file.recorder import Done
from hood.rollouts.frame import Ease, Frame
from hood.scene.scene import Scene
from hood.steppers.newton import Stepper, remembers

#: From one write to the next it takes so many times as long as a write, at least: long frames are kept one by one.
_APART = 20.0


@dataclass(frozen=True)
class RolloutProgress:
    """A rollout after a simulated frame: all that the next frames depend on beside its settings and files."""

    frame: Frame  # with its state
    done: Done  # of the file
    known: Sequence[Frame] = ()  # simulated frames that stored ones will be made of, where these have a rate of their own
    guard: Mapping[str, Any] = field(default_factory=dict)  # of hood.rollouts.checks.guard.Guard.memory
    goal: Mapping[str, Any] = field(default_factory=dict)  # of hood.steppers.refined.RefinedStepper.learned
    eases: Sequence[Ease | None] = ()
    warnings: Sequence[str] = ()


class ProgressFile:
    """``rollout.state`` in the folder of a rollout that runs: written after every frame, or every few of short ones, and where
    the rollout ends too early.

    It has one size, however long the rollout.

    Args:
        folder: of the rollout.
        scene: what it simulates.
        stepper: what takes its steps; of one that remembers more than there is to keep, nothing is written
            (:func:`hood.steppers.newton.remembers`).
    """

    def __init__(self, folder: Path, scene: Scene, stepper: Stepper) -> None:
        self._path, self._made_of = folder / STATE, _made_of(scene)
        self._keeps, self._due = not remembers(stepper), -np.inf
        self._now: RolloutProgress | None = None

    def keep(self, now: RolloutProgress) -> None:
        """Remember where the rollout is; write it where the last time was a while ago.

        Raises:
            OSError: the disk refuses.
        """
        if self._keeps:
            self._now = now
            if time.monotonic() >= self._due:
                self.write()

    def write(self) -> bool:
        """Write where the rollout is, whole or not at all; whether there was anything to write.

        Raises:
            OSError: the disk refuses.
        """
        if self._now is None:
            return False
        begun = time.monotonic()
        write_atomically(self._path, _packed(self._now, self._made_of))
        ended = time.monotonic()
        self._due = ended + _APART * (ended - begun)
        return True

    def write_last(self) -> bool:
        """Write where a rollout is that ends too early; whether ``resume=true`` can go on, from there or from before."""
        try:
            self.write()
        except OSError:
            pass  # a full disk; what was written before is there
        return self._path.exists()

    def remove(self) -> None:
        """The rollout is whole."""
        self._path.unlink(missing_ok=True)


def find_progress(folder: Path, config: RolloutSettings, digest: str, scene: Scene, stepper: Stepper) -> RolloutProgress | None:
    """Where the rollout in ``folder`` was stopped; None where there is none, or none that goes on as ``config`` asks: a
    sentence says why.

    Args:
        config: as asked for.
        digest: SHA-256 of the weights.
    """
    attributes = attributes_of(folder)
    if attributes is None:
        return None
    found, why = _read(folder, attributes, scene)
    if found is not None:
        why = _why_not(found, attributes, config, digest, scene, stepper)
    if found is None or why:
        say(f"resume=true: the rollout in {folder} is made again ({why})")
        return None
    say(f"resume=true: {folder} goes on after frame {found.done.frames - 1}")
    return found


def memories(guard: Guard | None, stepper: Stepper) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """What guard and goal know, for :class:`RolloutProgress`."""
    return ({} if guard is None else guard.memory), getattr(stepper, "learned", {})


def recall(found: RolloutProgress, folder: Path, guard: Guard | None) -> None:
    """Let a new guard know what that of the stopped rollout knew."""
    if guard is not None:
        with h5py.File(folder / "rollout.h5", "r") as file:
            guard.recall(found.guard, alarms_in(file)[: found.done.alarms])


def _why_not(
    found: RolloutProgress, attributes: Mapping[str, Any], config: RolloutSettings, digest: str, scene: Scene, stepper: Stepper
) -> str:
    """Why a rollout does not go on from there; "" where it does."""
    other = other_settings(config, dict(attributes))
    if found.frame.index + 1 < min(int(config.num_frames), scene.num_frames):  # its last frame is still to come
        other.pop("num_frames", None)
    for key, there in other.items():
        return f"{key} is {brief(there)} there, {brief(config[key])} in this command"
    if str(attributes.get("checkpoint_sha256")) != digest:
        return "it was begun with other weights"
    return "what takes its steps remembers more than a file keeps" if remembers(stepper) else ""


def _read(folder: Path, attributes: Mapping[str, Any], scene: Scene) -> tuple[RolloutProgress | None, str]:
    """What the file says; None, and why it is of no use."""
    if "store" in attributes or not (folder / STATE).is_file():
        return None, "no rollout.state there says where it was stopped"
    try:
        with np.load(io.BytesIO((folder / STATE).read_bytes()), allow_pickle=False) as file:
            arrays = dict(file)
        said = json.loads(arrays.pop("said").tobytes())
        for what, there in said["made_of"].items():
            if _made_of(scene).get(what) != there:
                return None, f"{what} is not what it was then"
        found = _unpacked(arrays, said, scene)
    except (OSError, ValueError, KeyError, TypeError, IndexError, zipfile.BadZipFile):
        return None, f"its {STATE} is damaged"
    if found.done.frames > int(attributes.get("num_frames", 0)):
        return None, f"its {STATE} is of another rollout"
    return found, ""


def _made_of(scene: Scene) -> dict[str, str]:
    """What a rollout is simulated from, in digests: settings name files, and these may have changed."""
    body = scene.motion.surface(0, scene.motion.translation[0])
    parts = [getattr(scene.cloth, part.name) for part in fields(scene.cloth)]
    if scene.fastening is not None:
        parts += [scene.fastening.row, scene.fastening.pairs.edges]
    return {
        "the version of hood or torch": f"{__version__} {torch.__version__}",
        "the garment or its fabric": _digest(parts),
        "the body": _digest([body, torch.as_tensor(scene.motion.faces)]),
    }


def _digest(values: Sequence[Any]) -> str:
    found = hashlib.sha256()
    for value in values:
        if isinstance(value, Tensor):
            found.update(value.detach().cpu().contiguous().numpy().tobytes())
    return found.hexdigest()


def _packed(now: RolloutProgress, made_of: Mapping[str, str]) -> bytes:
    state, arrays = now.frame.state, {}
    for name in ("pos", "vel", "origin"):
        arrays[name] = getattr(state, name).cpu().numpy()
    for place, frame in enumerate(now.known):
        arrays[f"known/{place}/pos"] = frame.world_pos.numpy()
        arrays[f"known/{place}/origin"] = frame.state.origin.cpu().numpy()
        arrays |= {f"known/{place}/{name}": values.numpy() for name, values in frame.fields.items()}
    said = {
        "made_of": made_of,
        "index": now.frame.index,
        "far": bool(now.frame.far),
        "done": now.done._asdict(),
        "known": [{"index": frame.index, "metrics": frame.metrics, "fields": list(frame.fields)} for frame in now.known],
        "guard": now.guard,
        "goal": now.goal,
        "eases": [None if ease is None else asdict(ease) for ease in now.eases],
        "warnings": list(now.warnings),
    }
    arrays["said"] = np.frombuffer(json.dumps(said).encode(), np.uint8)
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **arrays)
    return content.getvalue()


def _unpacked(arrays: Mapping[str, np.ndarray], said: Mapping[str, Any], scene: Scene) -> RolloutProgress:
    like = scene.cloth.rest_pos
    pos, vel, origin = (torch.from_numpy(arrays[name]) for name in ("pos", "vel", "origin"))
    if pos.shape != like.shape or vel.shape != like.shape or pos.dtype != like.dtype or origin.shape != (1, 3):
        raise ValueError("not a state of this cloth")
    state = State(pos.to(like.device), vel.to(like.device), origin)
    known = []
    for place, one in enumerate(said["known"]):
        world, there = torch.from_numpy(arrays[f"known/{place}/pos"]), torch.from_numpy(arrays[f"known/{place}/origin"])
        body = scene.motion.surface(one["index"], there[0].numpy()).cpu().double() + there[0]
        own = {name: torch.from_numpy(arrays[f"known/{place}/{name}"]) for name in one["fields"]}
        moving = State((world - there[0]).to(like), torch.zeros_like(like), there)
        known.append(Frame(one["index"], moving, world, body, one["metrics"], own))
    eases = [None if ease is None else Ease(**{**ease, "gap": tuple(ease["gap"])}) for ease in said["eases"]]
    done = Done(*(int(said["done"][name]) for name in Done._fields))
    frame = Frame(int(said["index"]), state, pos, pos, {}, far=bool(said["far"]))
    return RolloutProgress(frame, done, known, said["guard"], said["goal"], eases, said["warnings"])
