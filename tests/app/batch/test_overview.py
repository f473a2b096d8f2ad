"""The summary over many motions keeps the rows of every call."""

from __future__ import annotations

import json
import threading
from pathlib import Path

from hood.app.batch.batch import write_overview


def place(folder: Path, *names: str) -> dict[str, Path]:
    """Folders with a rollout of motions, by their files."""
    for name in names:
        (folder / name).mkdir(parents=True)
        (folder / name / "rollout.h5").write_bytes(b"")
    return {f"in/{name}.npz": folder / name for name in names}


def read(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def test_rows_of_other_calls_stay_and_own_ones_are_replaced(tmp_path: Path) -> None:
    first, second = place(tmp_path, "a", "b"), place(tmp_path, "c")
    write_overview(tmp_path, {name: {"call": 1} for name in first}, first)
    write_overview(tmp_path, {name: {"call": 2} for name in second}, second)
    again = {"other/words/a.npz": tmp_path / "a"}
    write_overview(tmp_path, {name: {"call": 3} for name in again}, again)
    assert {name: row["call"] for name, row in read(tmp_path)["motions"].items()} == {
        "in/b.npz": 1, "in/c.npz": 2, "other/words/a.npz": 3,
    }  # fmt: skip
    assert read(tmp_path)["num_motions"] == 3


def test_rows_whose_rollout_is_gone_go_with_it(tmp_path: Path) -> None:
    folders = place(tmp_path, "a", "b") | {"in/bad.npz": tmp_path / "bad"}
    write_overview(tmp_path, {name: {"error": "broken"} if "bad" in name else {} for name in folders}, folders)
    (tmp_path / "a" / "rollout.h5").unlink()
    write_overview(tmp_path, {}, {})
    assert [*read(tmp_path)["motions"]] == ["in/b.npz", "in/bad.npz"]


def test_a_call_that_is_interrupted_leaves_the_rows_that_it_did_not_reach(tmp_path: Path) -> None:
    folders = place(tmp_path, "a", "b")
    write_overview(tmp_path, {name: {"call": 1} for name in folders}, folders)
    write_overview(tmp_path, {"in/a.npz": {"call": 2}}, folders)
    assert [row["call"] for row in read(tmp_path)["motions"].values()] == [2, 1]
    assert read(tmp_path)["num_motions"] == 2


def test_what_is_no_summary_of_many_is_replaced(tmp_path: Path) -> None:
    folders = place(tmp_path, "a")
    for text in ("half a fi", '{"sound": true}', '{"motions": {"a": 1}}', '{"motions": []}', "[]"):
        (tmp_path / "summary.json").write_text(text)
        write_overview(tmp_path, {"in/a.npz": {"call": 1}}, folders)
        assert read(tmp_path)["motions"] == {"in/a.npz": {"call": 1}}


def test_calls_at_the_same_time_lose_no_row(tmp_path: Path) -> None:
    names = [f"m{index}" for index in range(24)]
    folders = place(tmp_path, *names)
    calls = [threading.Thread(target=write_overview, args=(tmp_path, {name: {}}, {name: folders[name]})) for name in folders]
    for call in calls:
        call.start()
    for call in calls:
        call.join()
    assert {*read(tmp_path)["motions"]} == {*folders}
