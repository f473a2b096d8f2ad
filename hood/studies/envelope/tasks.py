"""The rollouts of the stability map: which there are, and the command of each."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from hood.app.candidates import split_refinement
from hood.app.settings.compose import ConfigError
from hood.app.stepping.steppers import find_option
from hood.assets.files.library import locate
from hood.evaluation.table import GUESS, NEWTON
from hood.studies.envelope.cells import NOMINAL, Cell, cells
from hood.studies.envelope.extreme_files import write_garment, write_motion, write_still_body
from hood.studies.tradeoff.grid import quoted_word

#: The solver at a quarter of the time step, which the solver itself is held against; and no rollout has more frames per second.
REFERENCE, _FINER, _MOST_FPS = "newton, dt/4", 4, 1000.0
#: Behind a method's name: the guard repairs its steps.
_REPAIR = "+repair"


@dataclass(frozen=True)
class Task:
    """A rollout of the map."""

    cell: Cell
    garment: str
    model: str

    def folder(self, output: Path) -> Path:
        garment = re.sub(r"[^\w.-]+", "+", self.garment).strip("+")
        return output / "cells" / self.cell.name / garment / self.model.replace(", ", "_").replace("/", "-")

    def beside(self, model: str) -> Task:
        """The rollout of another method in the same cell."""
        return replace(self, model=model)

    @property
    def alone(self) -> bool:
        """Whether a network alone takes the steps."""
        name, refine, _ = _parts(self.model)
        return refine is None and name != REFERENCE and find_option(name) is None


def make_tasks(config: DictConfig) -> list[Task]:
    """All rollouts of the map, of each cell those that others are held against first. The finer ones of the solver need not all
    be made.

    Raises:
        ConfigError: no such factor, or no model or garment.
        FileNotFoundError: there is no such model, garment or motion.
    """
    known = list(dict.fromkeys(cell.factor for cell in cells()))
    wanted = [str(name) for name in config.factors]
    unknown = [name for name in wanted if name not in known]
    if unknown:
        raise ConfigError(f"factors: {unknown[0]!r} is none of them; choose {', '.join(known)}")
    models, garments = [str(name) for name in config.models], [str(name) for name in config.garments]
    if not models or not garments:
        empty = "garments" if models else "models"
        raise ConfigError(f"{empty}=[]: give at least one, such as {empty}={'[dress]' if models else '[newton]'}")
    for model in models:
        name = _parts(model)[0]
        if find_option(name) is None:
            locate("weights", name)
    for garment in garments:
        locate("garments", garment)
    locate("motions", str(config.sequence))
    methods = [REFERENCE, NEWTON, *(model for model in models if model != NEWTON)]
    return [
        Task(cell, garment, model)
        for cell in _chosen(wanted, bool(config.long))
        for garment in _garments_of(cell, garments)
        for model in methods
        if not (cell.bad_input and model not in models) and not (cell.long and model == REFERENCE)
    ]


def _chosen(wanted: Sequence[str], long: bool) -> list[Cell]:
    """The nominal cell, with which others are compared, is always one of them, and the first; a long factor that is named is
    wanted."""
    found = [cell for cell in cells() if cell.factor == NOMINAL or not wanted or cell.factor in wanted]
    return [cell for cell in found if long or not cell.long or cell.factor in wanted]


def _garments_of(cell: Cell, garments: Sequence[str]) -> Sequence[str]:
    """Input that is refused is refused for one garment as for all."""
    return [cell.garment] if cell.garment is not None else garments[:1] if cell.bad_input else garments


def write_inputs(tasks: Sequence[Task], folder: Path) -> None:
    """Write the motions, garments and bodies of the rollouts that bring their own; those that are there stay."""
    (folder / "inputs").mkdir(exist_ok=True)
    for task in tasks:
        cell = task.cell
        motion, garment, body = _motion(cell, folder), _garment(cell, task.garment, folder), _still_body(folder)
        if cell.motion is not None and not motion.exists():
            write_motion(motion, cell.motion, cell.seconds + 1.0)
        if cell.fault is not None and not garment.exists():
            write_garment(garment, task.garment, cell.fault)
        if cell.still_body and not body.exists():
            write_still_body(body)


def _motion(cell: Cell, folder: Path) -> Path:
    longer = "_long" if cell.long else ""
    return folder / "inputs" / f"{(cell.motion or '').replace(':', '_')}{longer}.npz"


def _garment(cell: Cell, garment: str, folder: Path) -> Path:
    return folder / "inputs" / f"{garment}_{(cell.fault or '').replace(':', '_')}.npz"


def _still_body(folder: Path) -> Path:
    return folder / "inputs" / "body.obj"


def command_of(task: Task, config: DictConfig, folder: Path) -> tuple[str, ...]:
    """The arguments of ``hood`` that make a rollout of the map."""
    cell = task.cell
    finer = min(_FINER, int(_MOST_FPS / cell.fps)) if task.model == REFERENCE else 1
    settings = [text for text in cell.settings if finer == 1 or not text.startswith("fps=")]
    if finer > 1:
        settings.append(f"fps={finer * cell.fps:g}")
    asked = (
        f"garment={_garment_word(task, folder)}",
        *_performed(cell, config, folder),
        f"num_frames={finer * (cell.num_frames - 1) + 1}",
        *settings,
    )
    often = () if any(text.startswith("metrics=") for text in settings) else ("metrics={surface_every:1}",)
    drawn = (*(often if finer == 1 else ("metrics=strain",)), "video=none", "sheet=false")
    return ("rollout", *asked, *_method(task.model), *drawn, f"output={quoted_word(str(task.folder(folder) / 'rollout'))}")


def _garment_word(task: Task, folder: Path) -> str:
    if task.cell.fault is not None:
        return quoted_word(str(_garment(task.cell, task.garment, folder)))
    return task.garment if task.garment.startswith("[") else quoted_word(task.garment)


def _performed(cell: Cell, config: DictConfig, folder: Path) -> tuple[str, ...]:
    """The body and its motion."""
    if cell.still_body:
        return (f"body={quoted_word(str(_still_body(folder)))}", "sequence=none")
    motion = _motion(cell, folder) if cell.motion is not None else cell.sequence or config.sequence
    return (f"sequence={quoted_word(str(motion))}",)


def _method(model: str) -> tuple[str, ...]:
    name, refine, repaired = _parts(model)
    guard = ("guard=repair",) if repaired else ()
    if name in (NEWTON, REFERENCE):
        return ("stepper=newton", *guard)
    if find_option(name) is not None:
        return (f"stepper={'refine' if name == GUESS else name}", f"refine={refine or 0}", *guard)
    return (f"checkpoint={name}", f"refine={refine or 0}", *guard)


def _parts(model: str) -> tuple[str, int | None, bool]:
    """``NAME+k+repair`` as the name, k (None where there is none), and whether the guard repairs."""
    name, refine = split_refinement(model.removesuffix(_REPAIR))
    return name, refine, model.endswith(_REPAIR)


@cache
def weights_of(model: str) -> str:
    """SHA-256 of the weights; a map of others of the same name is not done."""
    name = _parts(model)[0]
    if name == REFERENCE or find_option(name) is not None:
        return "none"
    return hashlib.sha256(locate("weights", name).read_bytes()).hexdigest()


def read_judged(task: Task, folder: Path) -> dict[str, Any]:
    try:
        content = json.loads((task.folder(folder) / "cell.json").read_text())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
