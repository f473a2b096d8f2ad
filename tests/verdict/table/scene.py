"""One scene of the table of labelled rollouts: its files, its overrides of ``hood rollout``, and how it is run."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hood.cli.main import main

#: Writes a file into a folder and returns its path.
Maker = Callable[[Path], Path]

#: What takes the steps. Every scene names one, so that no default of the command changes what was seen.
STEPPERS: dict[str, tuple[str, ...]] = {
    "newton": ("stepper=newton",),
    "newton_1": ("stepper=newton", "solver.max_iterations=1"),
    "newton_3": ("stepper=newton", "solver.max_iterations=3"),
    "newton_direct": ("stepper=newton", "solver.linear=direct"),
    "quickstart": ("stepper=network", "checkpoint=quickstart", "refine=0"),
    "quickstart+1": ("stepper=network", "checkpoint=quickstart", "refine=1"),
    "quickstart+5": ("stepper=network", "checkpoint=quickstart", "refine=5"),
    "edges": ("stepper=network", "checkpoint=edges", "refine=0"),
    "edges+5": ("stepper=network", "checkpoint=edges", "refine=5"),
    "ours": ("stepper=network", "checkpoint=small-ours", "refine=0"),
    "ours+5": ("stepper=network", "checkpoint=small-ours", "refine=5"),
    "fine15": ("stepper=network", "checkpoint=small-fine15", "refine=0"),
    "fine48": ("stepper=network", "checkpoint=small-fine48", "refine=0"),
    "small1": ("stepper=network", "checkpoint=small1", "refine=0"),
    "untrained_small": ("stepper=network", "checkpoint=untrained", "model=small", "refine=0"),
    "untrained_blocks": ("stepper=network", "checkpoint=untrained", "model=passes", "refine=0"),
    "untrained_global": ("stepper=network", "checkpoint=untrained", "model=forces", "refine=0"),
    "untrained_paper": ("stepper=network", "checkpoint=untrained", "model=ours", "model.latent_dim=16", "refine=0"),
    "guess": ("stepper=guess",),
    "guess+1": ("stepper=refine", "refine=1"),
    "guess+5": ("stepper=refine", "refine=5"),
    "sweeps+5": ("stepper=refine", "refine={goal:5,method:sweeps}"),
    "sweeps+40": ("stepper=refine", "refine={goal:40,method:sweeps}"),
}


@dataclass(frozen=True)
class Scene:
    """A rollout of the table.

    Args:
        kind: what it is about; scenes of one kind have one cause.
        stepper: one of :data:`STEPPERS`.
        garment, sequence, body: embedded names, or what writes the file.
        frames: simulated frames.
        keys: further overrides; ``{folder}`` stands for the folder of its inputs.
        needs: behaviour of the loader that the label depends on, empty for none.
    """

    name: str
    kind: str
    stepper: str
    garment: str | Maker
    sequence: str | Maker = "walk_proud"
    frames: int = 20
    keys: tuple[str, ...] = ()
    body: str | Maker = "default"
    needs: str = ""

    def __post_init__(self) -> None:
        if isinstance(self.keys, str):
            raise TypeError(f"{self.name}: keys is a tuple of overrides, not the text {self.keys!r}")

    def overrides(self, folder: Path) -> list[str]:
        """Arguments of ``hood rollout``; writes the inputs into ``folder``/inputs and asks for the results in ``folder``."""
        inputs = folder / "inputs"
        inputs.mkdir(parents=True, exist_ok=True)
        given = {"garment": self.garment, "sequence": self.sequence, "body": self.body}
        words = [f"{key}={value if isinstance(value, str) else value(inputs)}" for key, value in given.items()]
        words += [*STEPPERS[self.stepper], f"num_frames={self.frames}", "video=none", "sheet=false", "metrics=all"]
        return [*words, *(key.replace("{folder}", str(inputs)) for key in self.keys), f"output={folder}"]


def run(scene: Scene, folder: Path) -> tuple[dict[str, Any], int]:
    """What ``summary.json`` holds, and the exit code; files are left in ``folder``. Refused scenes have an empty summary."""
    code = main(["rollout", *scene.overrides(folder)])
    summary = folder / "summary.json"
    return (json.loads(summary.read_text()) if summary.exists() else {}), code


def run_unread(scene: Scene, folder: Path) -> str:
    """Runs the scene without a word about its result; returns why it was refused, empty where it was not.

    Whoever labels pictures must not have read what the command thinks of them.
    """
    words = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(words):
        _, code = run(scene, folder)
    refused = [line for line in words.getvalue().splitlines() if line.startswith("hood: error:")]
    return "\n".join(refused) if code == 2 else ""
