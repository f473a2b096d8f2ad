"""A folder has one writer at a time, whatever ends that writer."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from hood.assets.files.atomic import OccupiedError, is_occupied, occupy

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="folders are not locked there")
ROOT = Path(__file__).parents[3]
HOLD = """
import sys, pathlib
from hood.assets.files.atomic import occupy
with occupy(pathlib.Path(sys.argv[1])):
    print(flush=True)
    input()
"""


def hold(folder: Path) -> subprocess.Popen[str]:
    """Another process that has the folder."""
    other = subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], cwd=ROOT, stdin=-1, stdout=-1, text=True)
    assert other.stdout is not None
    other.stdout.readline()
    return other


def test_a_second_writer_is_refused_and_the_first_goes_on(tmp_path: Path) -> None:
    with occupy(tmp_path):
        assert is_occupied(tmp_path)
        with pytest.raises(OccupiedError, match=f"{tmp_path}: another run is writing there"), occupy(tmp_path):
            pass
        assert is_occupied(tmp_path)
    assert not is_occupied(tmp_path)
    with occupy(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_killed_writer_gives_the_folder_back(tmp_path: Path) -> None:
    other = hold(tmp_path)
    assert is_occupied(tmp_path)
    other.kill()
    other.communicate()
    assert not is_occupied(tmp_path)


def test_those_who_look_do_not_disturb_each_other_or_the_writer(tmp_path: Path) -> None:
    import fcntl

    looking = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(looking, fcntl.LOCK_SH)
    assert not is_occupied(tmp_path)
    os.close(looking)
    with occupy(tmp_path):
        pass


def test_what_is_not_there_is_not_held(tmp_path: Path) -> None:
    assert not is_occupied(tmp_path / "none")
