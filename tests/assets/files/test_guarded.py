"""One kind of error for files that cannot be read: short, whatever another library says."""

from __future__ import annotations

from pathlib import Path

import pytest

from hood.assets.files.guarded import first_line, guarded


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
