"""The page of the stability map: one file that is XML, loads nothing and shows every cell."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from hood.rollouts.file.recorder import RolloutWriter
from hood.studies.envelope.judge import CLASSES, FIGURES, REFUSED, SILENT, SOUND, Criteria, Judged
from hood.studies.envelope.page import Curve, View, curve_svg, small_sheet, write_map_page
from hood.testing import grid, sphere


def view(value: str, model: str, kind: str, **more: Any) -> View:
    row = dict.fromkeys(FIGURES) | {"factor": "spin", "value": value, "garment": "dress", "model": model, "class": kind}
    reasons = () if kind == SOUND else ("strain p99 90% in the worst frame, beyond 25%", "a <b> & c; and more")
    row |= {
        "reasons": "; ".join(reasons),
        "exit_code": 0,
        "command": f"hood rollout garment='a b' x=<{value}>",
        "strain_p99": 0.9,
    }
    return View(row, Judged(kind, reasons, ("it moves & jumps",) if reasons else ()), **more)


def page(folder: Path, views: list[View]) -> ElementTree.Element:
    text = write_map_page(views, ["newton", "ours"], Criteria(), folder).read_text()
    assert not re.search(r"<script|<link|src=\"(?!data:)|url\(", text)
    assert "http" not in text.replace("http://www.w3.org/2000/svg", "")
    return ElementTree.fromstring(text.removeprefix("<!DOCTYPE html>\n"))


def test_every_cell_has_a_square_that_leads_to_its_reasons(tmp_path: Path) -> None:
    curve = Curve(np.linspace(0.1, 0.9, 500), np.full(500, np.nan))
    views = [view("1", "newton", SOUND), view("1", "ours", SILENT, curve=curve, solver=curve, picture=b"\xff\xd8jpeg")]
    views += [view("2", "newton", REFUSED), view("2", "ours", SOUND)]
    root = page(tmp_path, views)
    squares = root.findall(".//table[@class='map']//td")
    assert [square.get("class") for square in squares] == [f"k{CLASSES.index(item.row['class'])}" for item in views]
    for square, item in zip(squares, views, strict=True):
        link = square.find("a")
        assert link is not None
        (cell,) = (part for part in root.iter("section") if part.get("id") == str(link.get("href"))[1:])
        assert cell.findtext("code") == item.row["command"]
        told = [entry.text for entry in cell.iter("li")]
        assert told == [*item.judged.reasons, *item.judged.said]
    (picture,) = root.iter("img")
    assert str(picture.get("src")).startswith("data:image/jpeg;base64,/9hq")
    shares = [["".join(cell.itertext()) for cell in row] for row in root.findall(".//table")[0].iter("tr")]
    assert shares[1] == ["newton", "1", "100.0%", "0.0%", "0.0%", "0.0%", "1"]
    holds = [[cell.text for cell in row] for row in root.findall(".//table")[1].iter("tr")]
    assert holds == [["factor", "newton", "ours"], ["spin", "all 1", "1 of 2: 2"]]
    assert shares[2] == ["ours", "2", "50.0%", "0.0%", "0.0%", "50.0%", "0"]


def test_curves_keep_their_peaks_and_lie_on_each_other(tmp_path: Path) -> None:
    strain = np.full(1000, 0.1)
    strain[503] = 1.0
    fine = Curve(strain, np.full(1000, np.nan))
    coarse = Curve(strain[3::10], np.full(100, 0.0))
    root = ElementTree.fromstring(curve_svg(coarse, fine, "ours", Criteria()))
    lines = [line for line in root.iter("{http://www.w3.org/2000/svg}polyline")]
    points = [np.array([pair.split(",") for pair in str(line.get("points")).split()], dtype=float) for line in lines]
    solver, own = points[0], points[1]
    assert len(solver) == 120
    assert solver[:, 1].min() == own[:, 1].min() == pytest.approx(120 * (1 - 1 / 1.1), abs=0.1)
    assert solver[solver[:, 1].argmin(), 0] == pytest.approx(own[own[:, 1].argmin(), 0], abs=1.0)
    assert len(points[2]) == 0  # nothing was measured
    assert "nan" not in curve_svg(fine, None, "ours", Criteria())


def test_a_sheet_is_small_and_drawn_once_a_rollout(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    (rest, faces), (body, body_faces) = grid(6, 6, 0.1), sphere(2, 0.3)
    at = tmp_path / "rollout"
    at.mkdir()

    def write(frames: int) -> None:
        names = ("strain_p99",)
        with RolloutWriter(
            at / "rollout.h5", frames, rest, faces, body_faces, len(body), names, 1 / 30, {"garment": "dress"}
        ) as out:
            for frame in range(frames):
                shape = np.asarray(rest) + [0.0, 0.5, 0.0] if frame else np.full(np.shape(rest), np.nan)
                out.append(shape, np.asarray(body), {"strain_p99": float(frame == 4)})

    write(12)
    content = small_sheet(tmp_path)
    assert content is not None
    assert len(content) <= 25_000
    assert image.open(tmp_path / "sheet.jpg").size == (6 * 130, 180)  # five of twelve, and frame 4
    (tmp_path / "sheet.jpg").write_bytes(b"kept")
    assert small_sheet(tmp_path) == b"kept"
    later = (tmp_path / "sheet.jpg").stat().st_mtime_ns + 10**9
    os.utime(at / "rollout.h5", ns=(later, later))
    assert small_sheet(tmp_path) == content
