"""Files that are the old ones or the new ones."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from hood.assets.files.atomic import write_atomically


def test_replaced_and_kept(tmp_path: Path) -> None:
    path, keep = tmp_path / "a.json", tmp_path / "a.old.json"
    write_atomically(path, b"1", keep)
    assert not keep.exists()
    write_atomically(path, b"2", keep)
    assert (path.read_bytes(), keep.read_bytes()) == (b"2", b"1")
    write_atomically(path, b"3")
    assert (path.read_bytes(), keep.read_bytes()) == (b"3", b"1")
    assert sorted(item.name for item in tmp_path.iterdir()) == ["a.json", "a.old.json"]


def test_errors_name_the_file_and_leave_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    write_atomically(path, b"1")

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError) as error:
        write_atomically(path, b"2")
    assert (error.value.errno, error.value.filename) == (errno.ENOSPC, str(path))
    assert path.read_bytes() == b"1"
    assert [item.name for item in tmp_path.iterdir()] == ["a.json"]
    with pytest.raises(OSError, match="none") as error:
        write_atomically(tmp_path / "none" / "b.json", b"")
    assert error.value.errno == errno.ENOENT
