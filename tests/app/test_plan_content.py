"""What a plan was made for: one number of its words and of the files in them."""

from __future__ import annotations

from pathlib import Path

import pytest

from hood.app import plan_file
from hood.app.plan_file import content_digest


def test_files_of_the_same_size_are_told_apart_alone_and_in_a_folder(tmp_path: Path) -> None:
    folder = tmp_path / "bodies"
    (folder / "male").mkdir(parents=True)
    one, other = folder / "male" / "model.npz", tmp_path / "own.obj"
    words = ["garment=tank", f"body={folder}", f"garment={other}"]
    found = []
    for content in ((b"aa", b"bb"), (b"ab", b"bb"), (b"aa", b"ba"), (b"aa", b"bb")):
        one.write_bytes(content[0])
        other.write_bytes(content[1])
        found.append(content_digest(words))
    assert len(set(found)) == 3
    assert found[0] == found[3]
    one.rename(folder / "model.npz")
    assert content_digest(words) not in found
    assert content_digest(list(reversed(words[:2]))) == content_digest(words[:2])


def test_of_large_files_the_size_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plan_file, "_LARGE", 3)
    file, found = tmp_path / "own.obj", set()
    for content in (b"aaaa", b"bbbb", b"bbbbb"):
        file.write_bytes(content)
        found.add(content_digest([f"garment={file}"]))
    assert len(found) == 2
