"""Where hood is: a program or a Python that the user names, the add-on's own folder, or the PATH; and which version it is.

Installing it into the add-on's own folder.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from pathlib import Path

from .fault import BakeError

#: The first version that understands the commands of this add-on.
OLDEST = (0, 1, 0)
#: What pip knows hood as.
PACKAGE = "hood-cloth"
_WINDOWS = os.name == "nt"


def python_of(folder: Path) -> Path:
    """The Python of a virtual environment."""
    return folder / ("Scripts/python.exe" if _WINDOWS else "bin/python")


def find_hood(named: str, own: Path) -> list[str]:
    """The words that start hood.

    Args:
        named: program or Python of the preferences; empty: look for it.
        own: folder of the add-on's own installation.

    Raises:
        BakeError: it is nowhere; says what to do.
    """
    if named:
        given = Path(named).expanduser()
        found = shutil.which(str(given))
        if found is None:
            raise BakeError(f"{given}: no such program; name hood or its Python in the add-on's preferences")
        return _start(Path(found))
    if python_of(own).is_file():
        return _start(python_of(own))
    found = shutil.which("hood")
    if found is None:
        raise BakeError("hood is not installed; press Install hood in the add-on's preferences, or name its Python there")
    return [found]


def _start(program: Path) -> list[str]:
    return [str(program), "-m", "hood"] if re.match(r"(?i)python", program.name) else [str(program)]


def check_version(said: str, program: str) -> str:
    """The version in what ``hood --version`` has said.

    Raises:
        BakeError: it says none, or an older one than :data:`OLDEST`.
    """
    found = re.search(r"^hood (\d+)\.(\d+)\.(\d+)", said, re.MULTILINE)
    oldest = ".".join(map(str, OLDEST))
    if found is None:
        last = said.strip().splitlines()[-1] if said.strip() else "nothing"
        raise BakeError(f"{program}: is no hood ({last}); name hood or its Python in the add-on's preferences")
    version = tuple(int(number) for number in found.groups())
    if version < OLDEST:
        raise BakeError(
            f"{program}: is hood {'.'.join(map(str, version))}, the add-on needs {oldest} or newer; press Install hood"
        )
    return ".".join(map(str, version))


def install_commands(python: str, own: Path, source: str) -> list[list[str]]:
    """What makes the add-on's own installation: a virtual environment, then pip.

    Args:
        python: that makes the environment, 3.11 or newer.
        source: a wheel, a folder of wheels or of hood's code, or the address of an index.

    Raises:
        BakeError: it names nothing of these: a package of this name elsewhere may be another project's.
    """
    given = Path(source).expanduser()
    if not source:
        raise BakeError("no source is named; give a wheel, a folder, or the address of an index that has hood-cloth")
    if re.match(r"https?://", source):
        wanted = ["--index-url", source, PACKAGE]
    elif given.is_dir() and not (given / "pyproject.toml").is_file():
        wanted = ["--find-links", str(given), PACKAGE]
    elif given.exists():
        wanted = [str(given)]
    else:
        raise BakeError(f"{source}: no such wheel or folder; give one, or the address of an index")
    pip = [str(python_of(own)), "-m", "pip", "install", "--upgrade", *wanted]
    return [[python, "-m", "venv", "--clear", str(own)], pip]


def python_for(named: str) -> str:
    """The Python that makes the environment: the named one, or Blender's own.

    Raises:
        BakeError: there is no such program.
    """
    if not named:
        return sys.executable
    found = shutil.which(str(Path(named).expanduser()))
    if found is None:
        raise BakeError(f"{named}: no such program; name a Python 3.11 or newer")
    return found
