"""The Python of the README and the docs runs as it stands, page by page; rollouts are cut short. So does the tutorial."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pages import EXTENDING, EXTENDING_HAS_A_TEST, PAGES, ROOT, blocks

from hood.cli.main import main
from hood.rollouts.file.reader import read_rollout

#: Pages whose blocks run as they stand; the tutorial's need the files of its commands.
ELSEWHERE = {"tutorial.md", *([EXTENDING] if EXTENDING_HAS_A_TEST else [])}
WITH_PYTHON = [page for page in PAGES if page.name not in ELSEWHERE and any(b.language == "python" for b in blocks(page))]
#: Files that a reader brings.
MISSING = re.compile(r"my_\w+\.(obj|npz)")

#: What pages print, as far as they promise it.
PRINTED = {
    "README.md": ("2 torch.Size([",),
    "python.md": ("2 torch.Size([", "(169, 3)", "3 1016", "True", "(3, 1016, 3)"),
    "gradients.md": ("tensor(", "{'lame_mu': ", " mm"),
}


def run_page(page: Path) -> None:
    """Every block of Python of a page, in order, with the names of those before; at most three frames are simulated."""
    known: dict[str, object] = {"__name__": page.stem}
    for number, block in enumerate(block for block in blocks(page) if block.language == "python"):
        code = re.sub(r"num_frames=\d+", "num_frames=3", block.text)
        assert not [line for line in code.splitlines() if MISSING.search(line.partition("#")[0])]
        exec(compile(code, f"{page.name}, block {number}", "exec"), known)


@pytest.mark.parametrize("page", WITH_PYTHON, ids=lambda page: page.name)
def test_the_python_of_a_page_runs(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    run_page(page)
    printed = capsys.readouterr().out
    for line in PRINTED.get(page.name, ()):
        assert line in printed


def test_the_tutorial_leads_from_nothing_to_a_sound_rollout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = ROOT / "docs" / "tutorial.md"
    monkeypatch.chdir(tmp_path)
    texts = blocks(page)
    python = [block.text for block in texts if block.language == "python"]
    Path("own_files.py").write_text(python[0], encoding="utf-8")
    lines = [line for block in texts if not block.language for line in block.text.splitlines()]
    first = lines[: next(index for index, line in enumerate(lines) if "output=outputs/twirl" in line) + 1]
    assert len(first) <= 5
    assert first[:2] == ["make demo", ".venv/bin/python own_files.py"]
    exec(compile(python[0], "own_files.py", "exec"), {})
    told = []
    for line in first[2:]:
        words = line.split()[1:]
        short = ["num_frames=3", "video=none"] if words[0] == "rollout" else []
        code = main([*words, *short])
        told.append(capsys.readouterr().out)
        assert code == (1 if words[0] == "inspect" else 0), told[-1]
    inspected, prepared, simulated = told
    shown = next(block.text for block in texts if block.language == "text")
    assert all(line.partition("…")[0] in inspected for line in shown.splitlines())
    assert "nothing to repair" in inspected
    assert "holds 80 of 4240 vertices" in prepared
    assert any(line == "sound" or line.startswith("sound, with ") for line in simulated.splitlines())
    assert read_rollout("outputs/twirl/rollout.h5").cloth_pos.shape == (3, 4240, 3)
    for block in python[1:]:
        exec(compile(block.replace("num_frames=10", "num_frames=2"), page.name, "exec"), {})
    assert Path("body.obj").is_file()
