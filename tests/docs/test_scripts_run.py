"""The scripts and benchmarks of the README and the docs are run, cut short; others are listed, each with the reason."""

from __future__ import annotations

import os
import re
import runpy
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from pages import ROOT, command_lines, of_hood
from stand_ins import Desk

from hood.cli.main import ENVIRONMENT

LINES = [(page, line) for page, line in command_lines() if not of_hood(line)]


class Run(NamedTuple):
    """How lines with a pattern are cut short: parts of the line are replaced, words put behind it."""

    pattern: str
    words: str
    says: str  # a pattern that the script prints
    swap: tuple[str, str] = ("", "")
    slow: bool = False


RUN = (
    Run(r"accuracy\.py", "", r"every vertex 0\.1 mm off"),
    Run(r"batches\.py", "--garments tank --counts 1 --models quickstart --kernels torch --repeats 1", r"\| quickstart \|"),
    Run(r"beyond_training\.py", "--parts gravity --frames 2", r"newton: 10 g: \d", slow=True),
    Run(
        *(r"compiled_kernels\.py", "", r"(small-ours|quickstart|newton), 1,000 vertices: [\d,]+ operations, [\d,]+ kernels"),
        *((r"12000", "1000"),),
        slow=True,
    ),
    Run(r"convergence\.py garment", "--sizes 1k --fps 30 --methods newton", r"1k +30 +newton", slow=True),
    Run(r"convergence\.py strip", "", r"\(0\.\d+\)", slow=True),
    Run(r"gpu_frames\.py", "", r'"method": "newton 1"', (r"newton 5", "newton 1")),
    Run(r"step_distance\.py --cost", "--garments tank --motions plie --frames 3", r"tank +plie +guess\+5 +\d", slow=True),
    Run(
        r"step_distance\.py --rows",
        "--scenes tank_squats_24 --methods newton",
        r"newton +4 (.|\n)*said the same",
        (r"docs/images/", ""),
    ),
    Run(r"/distance\.py", "--garments tank --frames 2", r"tank", slow=True),
    Run(r"engine\.py$", "--iterations 20 --frames 2", r"2 of 2", (r"$", " tank")),
    Run(
        r"engine\.py --frame",
        "--iterations 1 --frames 3 --motions plie",
        r"\ball +1 ",
        (r"--frame [^-]*", "--frame tank "),
    ),
    Run(r"events_picture\.py", "", "", (r"rollout\.h5 docs/images/", "long.h5 ")),
    Run(r"extremes\.py", "--side 9 --frames 1", r"\| × 100 \| × 0\.1 \|"),
    Run(r"fabrics\.py", "", r"below_waistband"),
    Run(r"film\.py", "--rounds 1 --frames 2", r"s of processor", (r"outputs/dance", "long.h5")),
    Run(r"frame\.py", "--sizes 300 --models fine15 --precision fp32 --frames 3", r"\| fine15 \| torch \| fp32 \|"),
    Run(r"fuzz\.py", "--count 3", r"\| all \| 3 \|", slow=True),
    Run(r"guard\.py", "--garments tank --motions plie --steppers newton --frames 3", r"alarms 0, repairs 0 of 2"),
    Run(r"half\.py", "--garments tank --frames 12", r"\| tank \|", (r"A B", "A.safetensors B.safetensors")),
    Run(
        r"heads\.py (errors|projective)",
        "--garments tshirt --states 1 --frames 4 --solves 1 --kernels torch",
        r"\(tshirt\)|γ +\d",
    ),
    Run(r"layer_scenes\.py", "--scenes folding_strip --rates 30 --seconds 0.1", r"folding_strip +1/30"),
    Run(r"layers\.py", "--frames 2", r"tank\+skirt", (r"$", " tank+skirt@plie"), slow=True),
    Run(r"losses\.py", "--sides 9 --share 9 --repetitions 1", r"Share of the energies"),
    Run(r"network\.py", "--sizes 300 --models fine15 --rounds 1 --no-memory --forward-only", r"fine15", slow=True),
    Run(
        r"output_frames\.py",
        "--garment tank --seconds 0.2",
        r"plie",
        (r"output_frames\.py.*", "output_frames.py plie"),
        slow=True,
    ),
    Run(r"refined_mesh\.py", "", r"tank", (r"refined_mesh\.py.*", "refined_mesh.py --garments tank tank_4k --frames 4")),
    Run(r"textures_picture\.py", "", "", (r"outputs/patterns docs/images/", "patterns ")),
    Run(r"benchmarks/plan\.py", "--scenes tank_plie --frames 6 --accuracy none", r"same bits in 1 of 1"),
    Run(r"precision\.py", "", r"\| met \|"),
    Run(r"record_ranges\.py", "", r"trained on fps", (r"FILE KEY=VALUE …", "FILE.safetensors model=small model.latent_dim=8")),
    Run(
        r"first_steps\.py",
        "trainer.statistics_iterations=1 data.garments=[tank]",
        r"relaxing +2 (.|\n)*regular +2 ",
        (r"first_steps\.py 100", "first_steps.py 4"),
    ),
    Run(r"scaling\.py report", "", r"γ median"),
    Run(r"cut_pieces\.py", "", r"skirt_front\.npz: 4719 vertices(.|\n)*skirt_front_fine\.npz: 4519 vertices"),
    Run(r"gradient_errors\.py", "--cases 1", r"covered: \d of 1 cases"),
    Run(r"gradients\.py", "--garments tank --steps 2 --rounds 1 --memory-steps 2", r"tank +1016 +\d"),
    Run(r"preconditioners\.py$", "--frames 7", r"tank +\d.*×", (r"$", " tank")),
    Run(r"preconditioners\.py dress.*--time", "", r"tank +\d+ +\d", (r"dress.*", "tank --time")),
    Run(r"preconditioners\.py dress.*--parts", "--frames 7", r"tank +1 1\.00× +2, usual", (r"dress[^-]*", "tank ")),
    Run(r"preconditioners\.py dress(?!.*--time|.*--parts)", "", "", (r"dress.*", "tank --frames 7")),
    Run(r"sew_variants\.py", "--count 1 --designs tank --edge 0.06", r"1 of 1 garments in"),
    Run(r"sewing\.py", "--designs skirt --first 1 --betas 0 --edge 0.06", r"all: 1 of 1 sewn well"),
    Run(r"solver\.py", "--sides 9 --frames 2", r"one local sweep, 81 vertices"),
    Run(
        r"levels\.py", "--garments tank_4k --sequences plie --frames 3", r"mesh tank(.|\n)*60 fps(.|\n)*of 1 meshes", slow=True
    ),
    Run(r"stopping\.py", "--scenes tank_plie --frames 6 --states 2", r"2 states of tank_plie(.|\n)*8 iterations"),
    Run(r"starts\.py", "--models quickstart --states 1 --kernels torch", r"lower of quickstart", slow=True),
    Run(
        r"surface\.py",
        "--steppers newton --motions plie --frames 3",
        r"newton",
        (r"surface\.py[\w ]*?(?= --|$)", "surface.py tank"),
    ),
    Run(r"wrinkles\.py", "--frames 7 --most 1 --rates 3", r"wrinkles 3 +\d", (r"circle", "tank"), slow=True),
    Run(r"waves\.py", "--garments tshirt --states 1 --frames 4", r"tshirt", slow=True),
)
#: Lines that are not run, and why; what they call has tests elsewhere.
NOT_RUN = {
    r"build_assets\.py": "writes the data of the package anew, with packages from PyPI; tests/tools/assets tests that",
    r"/fit\.py": "fits for minutes; tests/app/test_fit.py does so in small",
    r"folds\.py": "sews garments and simulates them for minutes each",
    r"gallery\.py": "17 rollouts of 60 frames at 4,000 vertices",
    r"gpu(_checks)?\.py": "needs a CUDA device",
    r"heads\.py (controls|models)": "reads networks that benchmarks/recipes.py trains in hours",
    r"learn_motion\.py": "simulates and trains for a minute; tests/scripts runs it in small",
    r"kills\.py": "starts and kills trainings for minutes; tests/training/test_kills.py does so once",
    r"minima\.py": "a hundred minimisations to the end, minutes",
    r"order\.py": "trains three networks for half an hour, or minimises hundreds of steps to the end",
    r"peers\.py": "needs the simulators of others from PyPI",
    r"ranks\.py": "trains in several processes, minutes",
    r"recipes\.py": "trains networks, hours",
    r"reproduce\.py": "measures points of a chart of hood tradeoff again, hours",
    r"resolution\.py": "evaluates a dress in resolutions up to 12,000 vertices, minutes each",
    r"/training\.py": "times updates of several models, a minute for one update of each",
    r"viewer\.py": "needs headless Chromium",
    r"^make ": "makes an environment from PyPI; continuous integration runs make test and make docs",
}


def row_of(line: str) -> Run | None:
    bare = line.partition("#")[0].strip()
    return next((row for row in RUN if re.search(row.pattern, bare)), None)


def as_parameter(page: str, line: str) -> Any:
    row = row_of(line)
    return pytest.param(line, id=f"{page}: {line}", marks=[pytest.mark.slow] if row and row.slow else [])


def shortened(line: str, row: Run) -> list[str]:
    bare = line.partition("#")[0].strip()
    return [*shlex.split(re.sub(*row.swap, bare, count=1) if row.swap[0] else bare)[1:], *shlex.split(row.words)]


def exit_code(script: Path) -> object:
    try:
        runpy.run_path(str(script), run_name="__main__")
    except SystemExit as ended:
        return ended.code or 0
    return 0


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Desk:
    return Desk(tmp_path_factory.mktemp("desk"), os.chdir)


@pytest.fixture(scope="module")
def done() -> set[tuple[str, ...]]:
    """The words of what was run."""
    return set()


@pytest.fixture
def tidy(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Modules that scripts import from beside them are forgotten again."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    before = {*sys.modules}
    yield
    for name in {*sys.modules} - before:
        if str(getattr(sys.modules[name], "__file__", None) or "").startswith((f"{ROOT}/benchmarks", f"{ROOT}/scripts")):
            del sys.modules[name]


@pytest.mark.parametrize("line", [as_parameter(page, line) for page, line in LINES if row_of(line)])
def test_a_script_runs(
    line: str, desk: Desk, done: set[tuple[str, ...]], tidy: None, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    row = row_of(line)
    assert row is not None
    words = shortened(line, row)
    if tuple(words) in done:
        return
    monkeypatch.chdir(tmp_path)
    desk.lay(words, tmp_path)
    script = ROOT / words[0]
    for key, value in ENVIRONMENT.items():  # without these scripts begin again in a new process, in the place of this one
        monkeypatch.setenv(key, value)
    monkeypatch.setattr(sys, "argv", words)
    monkeypatch.setattr(sys, "path", [str(script.parent), *sys.path])
    capsys.readouterr()
    assert exit_code(script) == 0
    told = capsys.readouterr().out
    assert re.search(row.says, told), told
    if "events_picture" in line:
        assert (tmp_path / "events.png").stat().st_size
    if "cut_pieces" in line:
        assert {path.name for path in (tmp_path / "pieces").iterdir()} >= {
            "dress_side.npz",
            "skirt_front.npz",
            "dress_back_fine.npz",
        }
    done.add(tuple(words))


def test_every_line_is_run_or_is_listed_with_a_reason() -> None:
    for page, line in LINES:
        bare = line.partition("#")[0].strip()
        found = [row.pattern for row in RUN if re.search(row.pattern, bare)] + [at for at in NOT_RUN if re.search(at, bare)]
        assert len(found) == 1, f"{page}: {line}: {found}"
    for pattern in [*(row.pattern for row in RUN), *NOT_RUN]:
        assert any(re.search(pattern, line.partition("#")[0].strip()) for _, line in LINES), pattern
