"""Runs the commands that README and docs name on the stand-in and on the CPU: ``python documented.py FOLDER [PATTERN]``.

Rollouts, trainings and evaluations, cut short as the tests of the docs do, in one process. Prints a line of JSON a command.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path

import torch
import ways
from stand_ins import Desk
from test_commands_run import LINES, chosen, key_of, shortened

from hood.app.settings.compose import ConfigError

COMMANDS = ("rollout", "train", "evaluate")


def main(folder: Path, pattern: str = "") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    os.environ["HOOD_CACHE"] = str(folder / "cache")
    (folder / "desk").mkdir()
    desk = Desk(folder / "desk", os.chdir)
    for number, words in enumerate(asked()):
        if not re.search(pattern, " ".join(words)):
            continue
        text = io.StringIO()
        place = folder / f"{number:03d}"
        place.mkdir()
        try:
            with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
                found = run(desk, words, place)
        except ConfigError as error:  # one sentence, as HOOD_TRACEBACK shows it
            found = {"refused": str(error)}
        except BaseException:  # what a command may raise is what is looked for
            found = {"error": traceback.format_exc()}
        print(json.dumps({"words": " ".join(words), "text": text.getvalue()[-1500:]} | found), flush=True)


def asked() -> Iterator[list[str]]:
    """The words of every command, once; the device is left to come."""
    seen = set()
    for _, line in LINES:
        words = [word for word in shortened(chosen(line)) if not word.startswith(("device=", "output="))]
        if words[0] in COMMANDS and "--help" not in words and key_of(words) not in seen:
            seen.add(key_of(words))
            yield words


def run(desk: Desk, words: list[str], place: Path) -> dict[str, object]:
    os.chdir(place)
    desk.lay(words, place)
    with ways.one_start():
        codes = {device: ways.command(*words, device, place / "out") for device in ("cpu", "standin")}
    waits = sum(number for key, number in torch.standin.counts().items() if key.startswith("sync"))
    return {"codes": codes, "waits": waits} | ({"apart": apart(place / "out")} if words[0] == "rollout" else {})


def apart(folder: Path) -> dict[str, float]:
    """By rollout, how far [m] it is from the CPU's."""
    found = {}
    for path in sorted((folder / "cpu").rglob("rollout.h5")):
        name = path.relative_to(folder / "cpu").parent
        other = folder / "standin" / name / "rollout.h5"
        found[str(name)] = ways.between(path, other) if other.exists() else float("inf")
    return found


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
