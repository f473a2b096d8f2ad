"""One kind of error for files that cannot be read: short, whatever another library says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hood.assets.files.guarded import first_line, guarded, listed
from hood.assets.identify import identify


@pytest.mark.parametrize("said", ["x" * 9000, "first\n" + "x" * 9000])
def test_what_another_library_quotes_is_cut_off(said: str, tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(b"1")

    def read() -> None:
        raise KeyError(said)

    with pytest.raises(ValueError, match="not a readable thing") as told:
        guarded(path, "thing", read)
    assert str(path) in str(told.value)
    assert len(str(told.value)) < len(str(path)) + 400


def test_an_error_without_a_message_is_called_by_its_name() -> None:
    assert first_line(ValueError()) == "ValueError"
    assert first_line(ValueError("one\ntwo")) == "one"


def test_names_of_a_damaged_file_are_one_line() -> None:
    assert listed([]) == "(none)"
    assert listed(["pose", "tränsl", "a\nb\x02\u2028", "k" * 99]) == f"pose, tränsl, a?b??, {'k' * 40}…"
    assert listed([f"n{k}" for k in range(9)]) == "n0, n1, n2, n3, n4, n5, n6, n7 …"


def test_a_damaged_archive_is_refused_in_a_line(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", **{"poses\nof\x00ours": np.zeros(3)})
    with pytest.raises(ValueError, match=r"^[^\n]*has the keys poses\?of[^\n]*$"):
        identify(str(tmp_path / "a.npz"))
