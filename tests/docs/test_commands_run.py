"""Every command of ``hood`` in the README and the docs is run, cut short, on files like the ones that readers bring."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from pages import EXTENDING, EXTENDING_HAS_A_TEST, ROOT, command_lines, of_hood, words_of
from stand_ins import BRIEF, Desk

from hood.app.settings.compose import load_config
from hood.assets.files.library import locate
from hood.cli.main import main
from hood.studies.envelope import envelope
from hood.studies.envelope.tasks import make_tasks
from hood.studies.processes import Ended
from hood.studies.tradeoff.tradeoff import chosen_models, make_grid

#: What ``make`` runs of them.
RECIPES = re.findall(r"^\t\$\(BIN\)/(hood .*)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
LINES = [(page, line) for page, line in command_lines() if of_hood(line) and not (page == EXTENDING and EXTENDING_HAS_A_TEST)]
LINES += [("Makefile", line) for line in RECIPES]
#: What makes a rollout short.
TWO_FRAMES = ("num_frames=2", "video=none", "sheet=false")
#: What makes a validation short.
VALIDATED = ("trainer.validate_every=1", "data.validation_frames=3", "validation_states=0")


class Short(NamedTuple):
    """Words put behind those of the lines that the pattern finds; of two values of a key the later one counts."""

    pattern: str
    words: tuple[str, ...]
    why: str


SHORT = (
    Short("^rollout", TWO_FRAMES, "a step has all parts of the model; pictures and later events have tests of their own"),
    Short("^rollout(?!.*formats=).*texture=", ("formats=[glb]",), "an image is for pictures and exports; none are drawn"),
    Short("^rollout.*=dress_12k", ("garment=dress",), "another resolution of the same garment"),
    Short("^rollout.*=dress_4k", ("garment=dress",), "another resolution of the same garment"),
    Short("^rollout.*=circle_4k", ("garment=circle",), "another resolution of the same garment"),
    Short("^dress", ("num_frames=2", "workers=1", "engine=local"), "one process here; engines have tests elsewhere"),
    Short("^dress(?!.*rows=)", ("garments=[tank]", "fabrics=[default]"), "two rows; their product has tests elsewhere"),
    Short("^sew", ("edge=0.05", "sheet=none"), "a coarse mesh; the sheet has a test of its own"),
    Short("^train", BRIEF, "one update with one scene; the networks are as large as the lines'"),
    Short(
        "^train.*paper_fast.*time_scale=0.13", ("trainer.iterations=15", "trainer.statistics_iterations=1"),
        "one update after one that counts features",
    ),
    Short(r"^train.*split\.json", ("trainer.horizon.maximum=2", *VALIDATED), "the motions of these files have ten frames"),
    Short("^train.*EarlyStopping", ("data.garments=[tank]", *VALIDATED), "one validation, of one garment"),
    Short("^train.*time_scale=0.02", ("trainer.iterations=50",), "a fiftieth of which is one update"),
    Short("^evaluate.*garments_dict", ("num_frames=4", "gap_states=1", "gap_iterations=2"), "the least number of frames"),
    Short(
        "^evaluate(?!.*garments_dict)",
        ("garments=[tank]", "sequences=[plie]", "num_frames=4", "gap_states=1", "gap_iterations=2"),
        "the least number of frames of one garment; the line's own garments are there",
    ),
    Short("^evaluate(?!.*models=)", ("models=[newton]",), "one row of the table"),
    Short("^evaluate.*drift_frames", ("drift_frames=2", "models=[newton]"), "the step is the same"),
    Short(
        "^tradeoff",
        (
            "models=[untrained:small]", "precisions=[fp32]", "newton=false", "refined=none", "sequences=[plie]", "turns=1",
            "garments_1k=[tank]", "refine_1k=[0]", "guess_1k=[]", "frames_1k=4", "states_1k=1",
            *(f"{key}_{size}=[]" for size in ("4k", "12k") for key in ("garments", "models", "refine", "guess")),
            *(f"{key}_{size}=4" for size in ("4k", "12k") for key in ("frames", "states")), "shapes_12k=[[]]",
        ),
        "one point and the page with its charts; the line's own grid is made, not measured",
    ),
    Short(
        "^envelope",
        ("factors=[nominal]", "models=[newton]", "long=false", "timeout=900", "document=hood/studies/notes/stability.md"),
        "two rollouts and the page; the line's own rollouts are listed, not done",
    ),
    Short(r"^rollout.*plan=[0-9]", ("num_frames=12",), "windows of the plan that comes first are as long"),
    Short("^plan(?!.*experiment)", ("windows=1", "frames=1", "parts=[friction]", "num_frames=12"), "one row of the table"),
    Short("^plan.*experiment", ("updates=1", "scenes=2"), "as few as there may be"),
    Short("^fit", ("num_frames=2", "parameters=[size]"), "one parameter of two frames"),
    Short("^sizes", ("num_frames=1", "shapes=[[]]"), "the garments at rest, on one body"),
    Short("^sizes(?!.*sizes=)", ("sizes={S:0.95,M:1}",), "two of the sizes"),
    Short("^fabric.*output", ("edges=[0.03]",), "the coarsest mesh that there may be"),
    Short("^compare", ("video=none", "height=140"), "the sheet is made of the same pictures"),
)  # fmt: skip
#: What pages leave to the reader, as a pattern in a line, and a choice.
CHOICES = {
    r"garment=(NAME|…)": "garment=tank",
    r"sequence=MOTION": "sequence=plie",
    r"weights=NAME": "weights=quickstart model=passes",
    r"inspect FILE$": "inspect my_shirt.obj",
    r"checkpoint=…": "checkpoint=A/model.safetensors",
    r"hood dress$": "hood dress motions=plie",
    r"refine=…ms": "refine=50ms",
    r" size=…": " size=1.1",
    r",…\]": "]",
}
#: Exit codes of commands that have something to say against their files, and what.
EXIT_CODES = {
    "inspect skirt.obj twirl.npz": (1, "multiply it by 0.01"),
    "inspect rollout.h5": (1, "doubt: the guard saw"),  # of a network alone
}
#: Lines that wait for ``-m slow``, and which of the others are like them.
SLOW = (
    (r"^dress .*(dry_run|engine)", "other engines and the dry run, which have tests elsewhere; the line of rows is run"),
    (r"^evaluate .*models=\[(?!runs/(mine|fine15))(?!.*SMPL_)", "rows of other models, as of a run, a network and the solver"),
    (r"^fabric chiffon", "thirteen fabrics, as of two"),
    (r"^train .*weights=[B-E]/|^train model=edges .*weights=", "further stages of recipes, as the first two of one"),
    (r"^rollout .*\[tank,skirt\].*(dance_mixed|fabrics)", "an outfit, as in plie"),
    (r"^rollout .*plan=[0-9]", "a plan first, as hood plan makes it"),
    (r"^plan .*budget_ms", "the way to a budget from the same table"),
    (r"^sizes .*shapes", "sizes on bodies, as of hood sizes alone"),
    (r"^rollout .*sequence=walk_brisk", "fabrics, as in plie"),
    (r"skirt\.obj|skirt_prepared\.npz", "the tutorial, whose way to its first rollout has a test of its own"),
    (r"^rollout .*surface_every:1.* events", "events, as without surface_every"),
    (r"^rollout .*wind=.*refine=5", "wind, as by the solver"),
    (r"^rollout .*plie fabrics={below", "fabrics by part, as on the page of sizes, and woven ones"),
    (r"^rollout .*size=1\.1 stepper", "a factor, as of the line with three"),
    (r"^rollout .*fields:\[rg\].* refine=0", "the same with refine=5"),
    (r"^rollout garment=swing_4k .*material=silk", "a fabric by name, as of the README"),
    (r"^train -m ", "sweeps, which have tests of their own, as have the two launchers"),
    (r"^train weights=quickstart model=", "weights to start from, as by experiment=quickstart"),
    (r"^plan garment=dress sequence", "the scene of a plan, as of hood plan alone"),
    (r"^sizes garment=dress output", "another garment"),
    (r"^tradeoff", "the chart, which has tests of its own"),
    (r"^(inspect|prepare) .*my_shirt\.obj( my_walk\.npz)?$", "files of another name"),
)
#: Commands that are told which files to read; their bare names, as the text has them, ask for those.
READERS = {"inspect", "prepare", "view", "export", "compare", "convert", "sew", "fit"}


def chosen(line: str) -> list[str]:
    """The command and its words, with choices for what the page leaves open."""
    for pattern, choice in CHOICES.items():
        line = re.sub(pattern, choice, line)
    return words_of(line)


def shortened(words: Sequence[str]) -> list[str]:
    text = " ".join(words)
    rows = () if "--help" in words or words == [*READERS & {words[0]}] else SHORT
    return [*words, *(word for row in rows if re.search(row.pattern, text) for word in row.words)]


def key_of(words: Sequence[str]) -> tuple[str, ...]:
    """What tells commands apart: not where they write, and of several values of a key the last."""
    last = {word.partition("=")[0]: word for word in words if not word.startswith("output=")}
    return (words[0], *sorted(last.values()))


def value_of(words: Sequence[str], key: str, usual: str) -> str:
    given = [word.partition("=")[2] for word in words if word.startswith(f"{key}=")]
    return given[-1] if given else usual


def promised(words: Sequence[str]) -> list[str]:
    """Files that a command writes, as patterns."""
    command = words[0]
    output = value_of(words, "output", "")
    read = [word for word in words[1:] if "=" not in word]
    if command == "rollout":
        folder = output or "outputs/rollout"
        formats = [name for name in ("glb", "usd") if name in value_of(words, "formats", "")]
        names = ["rollout.h5", "summary.json", "config.yaml", *(f"rollout.{name}" for name in formats)]
        many = "/*" if re.search(r"sequence=(amass|\w+\.txt)", " ".join(words)) else ""
        return [f"{folder}{many}/{name}" for name in names]
    if command == "dress":
        return (
            []
            if "dry_run=true" in words
            else [f"{output or 'outputs/dress'}/{name}" for name in ("manifest.jsonl", "*/*/*/*/rollout.h5")]
        )
    if command in ("inspect", "fabric") and not output:
        return []
    if command == "export":
        form = value_of(words, "format", "glb")
        return [f"{output}/*.{form}"] if form == "pc2" else [output or f"{read[0]}/rollout.{form}"]
    if command == "sew":
        return [output]
    if command in ("view", "convert"):
        return [
            output or ("view.html" if command == "view" else value_of(words, "checkpoint", "").replace(".pth", ".safetensors"))
        ]
    if command == "prepare":
        return [output or value_of(words, "garment", "").replace(".obj", "_prepared.npz")]
    sheets = ["sheets/*.png"] if "contact_sheets=true" in words else []
    spectrum = {"table": ["spectrum.csv"], "picture": ["spectrum.csv", "spectrum.png"]}.get(value_of(words, "spectrum", ""), [])
    training = any(word.startswith(("experiment=", "trainer", "data.")) for word in words)
    if "-m" in words:
        return [f"{output or 'runs/sweep'}/*/{name}" for name in ("model.safetensors", "checkpoint.pt")]
    usual, names = {
        "train": ("runs/train", ["model.safetensors", "metrics.jsonl", "checkpoint.pt"]),
        "evaluate": ("outputs/evaluate", ["table.csv", "table.json", "table1.md", *sheets, *spectrum]),
        "tradeoff": ("outputs/tradeoff", ["index.html", "points.csv", "points.json", "*.png"]),
        "envelope": ("outputs/envelope", ["index.html", "envelope.json", "envelope.csv"]),
        "plan": ("outputs/plan", ["training_plan.json"] if training else ["plan.json", "plan.html"]),
        "sizes": ("outputs/sizes", ["sheet.png", "sizes.json"]),
        "fit": ("outputs/fit", ["fit.json", "loss.png", "beside.png"]),
        "fabric": ("", ["shadows.png", "fabrics.json"]),
        "compare": ("outputs/compare", ["contact_sheet.png", "key.json"]),
    }[command]
    return [f"{output or usual}/{name}" for name in names]


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Desk]:
    """Files made once for all lines; hierarchies and chosen kernels are kept as between a reader's commands."""
    folder = tmp_path_factory.mktemp("desk")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOOD_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.delenv("HOOD_TRACEBACK", raising=False)
        patch.setattr(envelope, "run_beside", run_here)
        yield Desk(folder, os.chdir)


def run_here(commands: Iterable[tuple[Any, Sequence[str], Path]], jobs: int, timeout: float) -> Iterator[tuple[Any, Ended]]:
    """The rollouts of a stability map in this process, two frames each; processes of their own have tests elsewhere."""
    for key, arguments, _ in commands:
        yield key, Ended(main([*arguments, "num_frames=2"]), "", 1.0)


@pytest.fixture(scope="module")
def done() -> set[tuple[str, ...]]:
    """The commands that were run, without the places of their files."""
    return set()


def check_whole(line: str) -> None:
    """What is left out of a measurement is there to be measured."""
    command, *words = chosen(line)
    if command == "evaluate":
        for name in load_config(command, words).garments:
            locate("garments", re.sub(r"(\.pkl):.*", r"\1", str(name)))
    if command == "envelope":
        assert make_tasks(load_config(command, words))
    if command == "tradeoff":
        config = load_config(command, words)
        assert make_grid(config, chosen_models(config)[0]).points()


def is_slow(line: str) -> bool:
    return any(re.search(pattern, " ".join(chosen(line))) for pattern, _ in SLOW)


def as_parameter(page: str, line: str) -> Any:
    return pytest.param(line, id=f"{page}: {line}", marks=[pytest.mark.slow] if is_slow(line) else [])


@pytest.mark.parametrize("line", [as_parameter(page, line) for page, line in LINES])
def test_a_command_does_what_it_promises(
    line: str, desk: Desk, done: set[tuple[str, ...]], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    words = shortened(chosen(line))
    if key_of(words) in done:
        return
    monkeypatch.chdir(tmp_path)
    desk.lay(words, tmp_path)
    capsys.readouterr()
    code = main(words)
    told = capsys.readouterr()
    if len(words) == 1 and words[0] in READERS:
        assert code == 2
        assert f"hood {words[0]} " in told.err  # an example of what to give
    elif "--help" in words:
        assert code == 0
        assert f"hood {words[0]}" in told.out
    else:
        check_whole(line)
        expected, sentence = EXIT_CODES.get(" ".join(words), (0, ""))
        assert code == expected, told
        assert told.out
        assert sentence in told.out
        for pattern in promised(words):
            files = list(tmp_path.glob(pattern))
            assert files, pattern
            assert all(file.stat().st_size for file in files), pattern
    done.add(key_of(words))


def test_most_lines_do_not_wait_and_every_row_of_the_tables_finds_one() -> None:
    texts = [" ".join(chosen(line)) for _, line in LINES]
    assert sum(not is_slow(line) for _, line in LINES) > 0.7 * len(LINES)
    for pattern in [*(row.pattern for row in SHORT), *(pattern for pattern, _ in SLOW)]:
        assert any(re.search(pattern, text) for text in texts), pattern
    for pattern in CHOICES:
        assert any(re.search(pattern, line) for _, line in LINES), pattern
    assert {*EXIT_CODES} <= {*texts}
    assert len(RECIPES) == 2
