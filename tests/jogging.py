"""Short rollouts of a jog by the solver, in a folder of their own."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from hood.cli.main import main
from hood.rollouts.file.reader import RolloutData, read_rollout

#: Without contact cloth passes through itself.
WORDS = ["sequence=jog", "start=1.0", "stepper=newton", "cloth_contact=off", "fail_on=nothing", "video=none", "sheet=false",
         "settle=paper"]  # fmt: skip


def jog(*words: str, output: str = "run") -> tuple[RolloutData, dict[str, Any]]:
    """What a rollout with further words has written into ``output``: its file and its summary."""
    assert main(["rollout", *WORDS, f"output={output}", *words]) == 0
    return read_rollout(Path(output) / "rollout.h5"), json.loads((Path(output) / "summary.json").read_text())
