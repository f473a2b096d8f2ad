"""What is said about skin through cloth and cloth through cloth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hood.app.output.verdict import cut_at_worst, describe_surface, summarise_surface
from hood.cli.main import main

NAN = float("nan")


def metrics(share: list[float], own: list[float], others: list[float]) -> dict[str, np.ndarray]:
    columns = {"cut_face_share": share, "cut_edge_share": share, "self_crossings": own, "garment_crossings": others}
    return {name: np.array(values) for name, values in columns.items()} | {"skin_depth": 0.1 * np.array(share)}


def test_worst_frames_are_named_and_warned_about() -> None:
    found = summarise_surface(metrics([0.0, NAN, 0.126, 0.06], [0, NAN, 1, 5], [0, NAN, 0, 0]), 2)
    assert found is not None
    assert (found["stride"], found["frames_measured"]) == (2, 3)
    assert found["cut_face_share"] == {"mean": pytest.approx(0.062), "worst": 0.126, "frame": 2}
    assert found["self_crossings"] == {"mean": 2.0, "worst": 5.0, "frame": 3}
    assert describe_surface(found) == [
        "surface (one frame in 2, first and last): the body cuts 6.2% of the cloth's triangles on average, 12.6% in frame 2, "
        "skin at most 12.6 mm above the cloth, 2.0 pairs of triangles of one garment pass through each other on average",
        "warning: the body's skin cuts 12.6% of the cloth's triangles in frame 2; the verdict counts what a viewer sees of it",
        "warning: 5 pairs of triangles of the cloth pass through each other in frame 3",
    ]
    assert cut_at_worst(found) == "skin cuts 12.6% at worst"


def test_a_whole_surface_is_said_to_be_whole_without_a_warning() -> None:
    lines = describe_surface(summarise_surface(metrics([0.0, 0.009], [0, 0], [0, 0]), 1))
    assert len(lines) == 1
    assert "on average, 0.9% in frame 1" in lines[0]
    crossed = describe_surface(summarise_surface(metrics([0.0, 0.0], [0, 0], [7, 0]), 1))
    assert crossed[1:] == ["warning: 7 pairs of triangles of two garments pass through each other in frame 0"]


def test_triangles_caught_in_folds_of_the_body_are_counted_and_told_apart() -> None:
    measured = metrics([0.002, 0.006], [0, 0], [0, 0])
    found = summarise_surface(measured | {"cut_in_folds": np.array([0.002, 0.005])}, 1)
    assert found is not None
    assert found["cut_face_share"]["worst"] == 0.006
    assert found["cut_apart_from_folds"] == {"mean": pytest.approx(0.0005), "worst": pytest.approx(0.001), "frame": 1}
    assert "0.6% in frame 1 (0.05% and 0.10% apart from where the body passes through itself)" in describe_surface(found)[0]
    plain = summarise_surface(measured | {"cut_in_folds": np.zeros(2)}, 1)
    assert describe_surface(plain) == describe_surface(summarise_surface(measured, 1))


def test_what_was_not_measured_is_not_claimed() -> None:
    assert summarise_surface({}, None) is None
    assert summarise_surface(metrics([NAN], [NAN], [NAN]), 5) is None
    assert describe_surface(None) == []
    assert cut_at_worst(None) == "skin through cloth n/a"


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("metrics={surface_every:0}", "surface_every is 0; it must be at least 1"),
        ("picture={thin_body:-1}", "give millimetres, 0"),
        ("thin_body=50", "to 20"),
    ],
)
def test_bad_values_are_refused(key: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rollout", "garment=tank", key, f"output={tmp_path / 'run'}"]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
