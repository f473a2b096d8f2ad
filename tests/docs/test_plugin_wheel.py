"""The package of docs/extending.md as a wheel, by both builders that the page names: its options come along, everywhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import h5py
import pytest
from test_extending import blocks, sections, write_package

OPTIONS = {
    f"my_cloth/configs/{name}.yaml"
    for name in ("losses/windy", "material/felt", "model/bounded", "stepper/damped", "data/tall")
}
#: Another table [build-system] of the page stands for the first one.
_BUILDER = re.compile(r"\[build-system\]\n.*?\n\n", re.DOTALL)


def python(*words: str | Path, where: Path, path: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Python with these words in the folder ``where``, without a compiler, with packages from ``path``."""
    environment = os.environ | {"CXX": "no-such-compiler"} | ({"PYTHONPATH": str(path)} if path else {})
    return subprocess.run([sys.executable, "-P", *words], cwd=where, env=environment, capture_output=True, text=True)


def write_project(folder: Path, builder: str) -> Path:
    """The page's package and its ``pyproject.toml`` for a builder, beside folders that commands have left."""
    for name in ("outputs", "runs"):
        (folder / name).mkdir(parents=True)
    text = "".join(sections().values())
    write_package(folder, text)
    first, *others = (body for _, language, body in blocks(text) if language == "toml")
    for body in others:
        first = _BUILDER.sub(f"{body}\n", first, count=1) if "[build-system]" in body and builder in body else first
        first += f"\n{body}" if "[build-system]" not in body else ""
    if builder == "hatchling":
        first = re.sub(r"\[tool\.setuptools.*?\n(?=\n|\Z)", "", first, flags=re.DOTALL)
    (folder / "pyproject.toml").write_text(first, encoding="utf-8")
    return folder


def install(folder: Path, target: Path) -> Path:
    """Build the wheel of a project and install it into ``target``; returns the wheel."""
    made = folder.parent / "wheels"
    words = ("wheel", "-q", "--no-build-isolation", "--no-deps", "-w", made, folder)
    done = python("-m", "pip", *words, where=folder)
    assert done.returncode == 0, done.stderr
    (wheel,) = made.iterdir()
    words = ("install", "-q", "--no-deps", "--no-index", "--no-compile", "--target", target, wheel)
    done = python("-m", "pip", *words, where=folder)
    assert done.returncode == 0, done.stderr
    return wheel


@pytest.mark.parametrize("builder", ["setuptools", "hatchling"])
def test_its_wheel_has_its_options_and_works_from_any_folder(builder: str, tmp_path: Path) -> None:
    project = write_project(tmp_path / "project", builder)
    assert f'requires = ["{builder}' in (project / "pyproject.toml").read_text(encoding="utf-8")
    wheel = install(project, tmp_path / "site")
    assert {*zipfile.ZipFile(wheel).namelist()} >= {*OPTIONS, "my_cloth/wind.py"}
    (tmp_path / "elsewhere").mkdir()
    words = ("losses=windy", "material=felt", "stepper=damped", "garment=tank", "num_frames=2", "video=none", "sheet=false")
    command = ("-m", "hood", "rollout", *words, "output=out", "fail_on=nothing")
    done = python(*command, where=tmp_path / "elsewhere", path=tmp_path / "site")
    assert done.returncode == 0, done.stderr
    with h5py.File(tmp_path / "elsewhere" / "out" / "rollout.h5") as file:
        assert file.attrs["stepper"] == "damped"
        assert "energy_wind" in file["metrics"]


def test_a_wheel_without_its_options_is_told_by_the_command_that_names_one(tmp_path: Path) -> None:
    project = write_project(tmp_path / "project", "setuptools")
    text = (project / "pyproject.toml").read_text(encoding="utf-8")
    (project / "pyproject.toml").write_text(text.replace("package-data]", "exclude-package-data]"), encoding="utf-8")
    install(project, tmp_path / "site")
    done = python("-m", "hood", "rollout", "losses=windy", where=project, path=tmp_path / "site")
    assert done.returncode == 2
    assert "unknown losses 'windy'" in done.stderr
    assert "'my_cloth' is installed without its files configs/GROUP/*.yaml" in done.stderr
    assert 'add [tool.setuptools.package-data] my_cloth = ["configs/**/*.yaml"]' in done.stderr
    assert done.stderr.count("\n") == 1
