"""The package has one name for pip, in every message, page and recipe, and what is built under it installs and runs."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tarfile
import tomllib
from pathlib import Path

import pytest

import hood
from hood.assets.files.said import DISTRIBUTION, install

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = set(PROJECT["optional-dependencies"])
#: Files that may tell a reader what to install.
SUFFIXES = {".py", ".pyi", ".md", ".toml", ".yaml", ".yml", ".cff", ".txt", ".html", ".js", ".sh", ""}
FOLDERS = ("hood", "configs", "docs", "benchmarks", "scripts", "tools", "tests", ".ci")
#: ``name[extra``, not behind a letter: a list of Python that ends so is no installation.
WITH_EXTRA = re.compile(r"(?<![\w.])(hood[\w.-]*)\[([\w,{}() ]+)\]")
#: What stands behind ``pip install`` up to the end of the line, the sentence or the quotes around it.
INSTALLED = re.compile(r"pip3? (?:install|download|show|wheel) ([^\n`;)]*)")


def texts() -> list[tuple[str, str]]:
    """Name and text of every file of the repository that somebody may read, this one apart."""
    found = [path for path in ROOT.iterdir() if path.is_file()]
    for folder in FOLDERS:
        found += [path for path in (ROOT / folder).rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    found = [path for path in found if path.suffix in SUFFIXES and path != Path(__file__)]
    return [(str(path.relative_to(ROOT)), path.read_text(encoding="utf-8")) for path in sorted(found)]


def wrong_names(text: str) -> list[str]:
    """Names of packages in a text that are installed under hood's name and are not this one, and extras that it has not."""
    wrong = []
    for name, extras in WITH_EXTRA.findall(text):
        unknown = {part for part in extras.split(",") if "{" not in part} - EXTRAS
        if name != DISTRIBUTION or unknown:
            wrong.append(f"{name}[{extras}]")
    for line in INSTALLED.findall(text):
        words = re.findall(r"(?<![\w./=-])hood[\w.-]*", line)
        wrong += [word for word in words if word.rstrip(".") != DISTRIBUTION]
    return wrong


def python(*words: str | Path, **variables: str) -> str:
    """Output of Python with these words, without a compiler; fails where the command does."""
    environment = os.environ | {"CXX": "no-such-compiler"} | variables
    command = [sys.executable, *map(str, words)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_every_text_installs_this_package() -> None:
    found = {name: wrong_names(text) for name, text in texts()}
    assert {name: wrong for name, wrong in found.items() if wrong} == {}
    told = [name for name, text in texts() if re.search(rf"{DISTRIBUTION}\[\w", text)]
    assert {"pyproject.toml", "docs/rollout.md", "docs/troubleshooting.md"} <= set(told)


@pytest.mark.parametrize("text", ['pip install "hood[usd]"', "needs `hood[charts]`", "pip install hood", "hood-cloth[films]"])
def test_another_name_or_extra_would_be_found(text: str) -> None:
    assert wrong_names(text)


def test_messages_name_it_and_extras_that_it_has() -> None:
    assert PROJECT["name"] == DISTRIBUTION != "hood"
    assert PROJECT["version"] == hood.__version__
    asked = [name for _, text in texts() for name in re.findall(r"\binstall\(['\"](\w+)['\"]\)", text)]
    assert {"pictures"} <= set(asked) <= EXTRAS
    assert install("charts") == f'pip install "{DISTRIBUTION}[charts]"'


def test_what_is_built_installs_and_runs(tmp_path: Path) -> None:
    """The wheel of the source archive has the files of the wheel of the folder; its command runs from elsewhere."""
    python("-m", "hatchling", "build", "-t", "sdist", "-d", tmp_path)
    (archive,) = tmp_path.glob("hood_cloth-*.tar.gz")
    with tarfile.open(archive) as file:
        file.extractall(tmp_path, filter="data")
    source = tmp_path / archive.name.removesuffix(".tar.gz")
    python("-m", "pip", "wheel", "-q", "--no-build-isolation", "--no-deps", "-w", tmp_path, source)
    (wheel,) = tmp_path.glob("hood_cloth-*.whl")
    target = tmp_path / "site"
    python("-m", "pip", "install", "-q", "--no-deps", "--no-index", "--no-compile", "--target", target, wheel)
    code = (
        "import hood, importlib.metadata as m, hood.app.settings.compose as c, pathlib; "
        f"print(m.version('{DISTRIBUTION}'), hood.__file__, c.CONFIG_FOLDER)"
    )
    assert python("-P", "-c", code, PYTHONPATH=str(target)).split() == [
        hood.__version__,
        str(target / "hood" / "__init__.py"),
        str(target / "hood" / "configs"),
    ]
    command = target / "bin" / "hood"
    assert python(command, "--version", PYTHONPATH=str(target)) == f"hood {hood.__version__} ({DISTRIBUTION})\n"
    words = ("garment=tank", "num_frames=2", "stepper=newton", "video=none", "sheet=false", f"output={tmp_path / 'out'}")
    assert "sound" in python(command, "rollout", *words, PYTHONPATH=str(target))
