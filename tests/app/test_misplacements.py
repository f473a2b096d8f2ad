"""Garment files that lie anywhere, in any unit, turned and posed: the command that ``hood inspect`` prints brings them back."""

from __future__ import annotations

import json
import random
import shlex
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from workshop import write_obj

from hood.app.scene import placing
from hood.app.scene.placing import find_place
from hood.assets.body.body import Body
from hood.assets.body.load import load_body
from hood.assets.fitting.fit_search import AskedFit, FoundFit
from hood.assets.fitting.placement import Placement
from hood.assets.garment.binding import posed_body
from hood.assets.garment.garment import Garment, load_garment
from hood.assets.motion.sequence_edit import arms_down
from hood.cli.main import main

GARMENTS = ("tshirt", "trousers", "dress", "tank", "longsleeve", "skirt")
SLEEVED = ("tshirt", "longsleeve")
#: Metres that a garment is moved away; "floor": the feet stand at the origin; "centre": the middle of its box is the origin.
SHIFTS = (
    (0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (0.0, -3.0, 0.0), (0.0, 0.0, 3.0), (1.8, 1.8, -1.8), "floor", "centre",
    (0.05, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, -0.05, 0.05), (0.0, 0.0, -0.1), (0.2, 0.2, 0.0),
)  # fmt: skip
UNITS = (1.0, 1.0, 0.1, 0.0254, 0.01, 0.001)
#: Shape coefficients: by number and value.
SHAPES = ((0, 0.0), (0, 0.0), (0, 2.0), (0, -2.0), (1, 2.0), (1, -2.0), (2, 2.0), (4, -2.0))
#: What counts as brought back.
NEAR, ANGLE, SIZE = 0.01, 3.0, 0.015


@dataclass(frozen=True)
class Case:
    """One misplaced file, and where it belongs."""

    garment: str
    shift: tuple[float, float, float] | str = (0.0, 0.0, 0.0)
    unit: float = 1.0
    up: str = "y"
    turn: float = 0.0
    angle: float = 0.0
    shape: tuple[int, float] = (0, 0.0)
    factor: float = 1.0  # times the size that it was made in

    @property
    def betas(self) -> np.ndarray:
        return np.eye(10)[self.shape[0]] * self.shape[1]

    @property
    def words(self) -> list[str]:
        """What the user says about the body."""
        return [f"betas={self.betas[: self.shape[0] + 1].tolist()}".replace(" ", "")] if self.shape[1] else []


def table() -> list[Case]:
    """Every garment moved by 3 m and as it is, and 72 mixtures in which every value of a column is as frequent."""
    cases = [Case(name, shift) for name in GARMENTS for shift in (SHIFTS[0], SHIFTS[1])]
    mixer, count = random.Random(17), 72
    columns: list[list[Any]] = []
    for values in (GARMENTS, SHIFTS, UNITS, ("y", "z"), (0.0, 90.0, 180.0, 270.0), (0.0, 0.0, 30.0, 45.0, 70.0), SHAPES):
        column = [values[i % len(values)] for i in range(count)]
        mixer.shuffle(column)
        columns.append(column)
    return cases + [Case(*row) for row in zip(*columns, strict=True)]


def sizes_table() -> list[Case]:
    """Garments too small and too large by 7 and 8%, in mixtures like those of :func:`table`."""
    mixer, count, names = random.Random(23), 42, (*GARMENTS, "shorts")
    columns: list[list[Any]] = []
    angles = (0.0, 0.0, 30.0, 45.0, 70.0)
    for values in (names, SHIFTS, UNITS, ("y", "z"), (0.0, 90.0, 180.0, 270.0), angles, SHAPES, (0.92, 1.08, 0.93, 1.07)):
        column = [values[i % len(values)] for i in range(count)]
        mixer.shuffle(column)
        columns.append(column)
    return [Case(*row) for row in zip(*columns, strict=True)]


@cache
def _default() -> Body:
    return load_body()


def truth(case: Case) -> tuple[Garment, np.ndarray, Placement]:
    """The garment, where its vertices (V, 3) [m] belong, and the placement that brings the file there."""
    garment, body = load_garment(case.garment), _default()
    assert garment.lbs_weights is not None
    transforms = posed_body(body, arms_down(case.angle), 0, case.betas).transforms
    rest = garment.tpose(case.betas)
    pos = np.einsum("vj,jab,vb->va", garment.lbs_weights, transforms, np.concatenate([rest, np.ones((len(rest), 1))], axis=1))
    if case.shift == "floor":
        offset = np.array([0.0, body.shaped(case.betas)[0][:, 1].min(), 0.0])
    elif case.shift == "centre":
        offset = (pos.min(axis=0) + pos.max(axis=0)) / 2
    else:
        offset = np.array(case.shift)
    return garment, pos, Placement(case.unit / case.factor, case.up, case.turn, offset, case.angle)


def bring_back(case: Case, capsys: pytest.CaptureFixture[str]) -> tuple[str, str]:
    """Write the file, run what inspect prints: ("right", "refused", "told" or what is wrong; the command).

    Told: the garment is taken in the size of its file, and its own is among those that inspect says fit about alike.
    """
    garment, pos, placement = truth(case)
    write_obj(Path("g.obj"), (pos - placement.offset) @ placement.rotation / placement.scale, garment.faces)
    main(["inspect", "g.obj", *case.words, "--json"])
    finding = json.loads(capsys.readouterr().out)["files"][0]
    command = finding["command"] or shlex.join(["hood", "prepare", "garment=g.obj", *case.words])
    code = main([*shlex.split(command)[1:], "output=g.npz"])
    error = capsys.readouterr().err
    if code != 0:
        return ("refused" if finding["command"] is None else f"the command fails: {error}"), command
    if finding["command"] is None and any("no place" in entry["problem"] for entry in finding["problems"]):
        return "inspect refuses, prepare does not", command
    (scale,) = [float(word.removeprefix("scale=")) for word in shlex.split(command) if word.startswith("scale=")] or [1.0]
    if abs(scale / placement.scale - 1.0) > SIZE:
        sizes = finding["facts"]["times its size it fits about alike"]
        alike = sizes == "its shape does not say" or sizes[0] <= 1.0 / case.factor <= sizes[1]
        told = alike and abs(scale / case.unit - 1.0) < 1e-6
        return ("told" if told else f"scale {scale}, not {placement.scale:.4g}"), command
    back = load_garment("g.npz").shaped(case.betas)
    far = float(np.linalg.norm(back - pos, axis=1).mean())
    angle = next(value for name, value in finding["facts"].items() if name.endswith("arms below the T-pose [degrees]"))
    if far > NEAR:
        return f"{100 * far:.1f} cm away", command
    if case.garment in SLEEVED and abs(angle - case.angle) > ANGLE:
        return f"arms at {angle:g} instead of {case.angle:g} degrees", command
    return "right", command


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HOOD_TRACEBACK", raising=False)


FEW = {
    "shirt, 3 m away": Case("tshirt", (3.0, 0.0, 0.0)),
    "top in inches, z up, seen from the side, arms down": Case("longsleeve", "floor", 0.0254, "z", 90.0, 45.0),
    "skirt in decimetres, back to front": Case("skirt", "centre", 0.1, "y", 180.0),
    "trousers of a tall body, 10 cm too high": Case("trousers", (0.0, -0.1, 0.0), shape=(0, 2.0)),
    "dress with hanging arms, z up": Case("dress", (0.0, 0.0, 3.0), up="z", turn=90.0, angle=70.0, shape=(1, 2.0)),
    "tank of a heavy body in millimetres, arms down": Case("tank", (0.0, -3.0, 0.0), 0.001, angle=45.0, shape=(1, -2.0)),
    "skirt of another body in inches": Case("skirt", "centre", 0.0254, turn=180.0, shape=(2, 2.0)),
    "skirt as loose elsewhere, in centimetres": Case("skirt", unit=0.01, turn=90.0, shape=(4, -2.0)),
}


@pytest.mark.parametrize("name", FEW)
def test_a_printed_command_brings_the_garment_back(capsys: pytest.CaptureFixture[str], name: str) -> None:
    assert bring_back(FEW[name], capsys)[0] == "right"


def test_prepare_alone_does_what_inspect_prints(capsys: pytest.CaptureFixture[str]) -> None:
    case = Case("tank", "floor", 0.01, "z", 270.0)
    assert bring_back(case, capsys)[0] == "right"
    printed = load_garment("g.npz").rest_pos
    assert main(["prepare", "garment=g.obj", "output=alone.npz"]) == 0
    np.testing.assert_allclose(load_garment("alone.npz").rest_pos, printed, atol=1e-4)


SIZES = {
    "tank too large by 8%, in centimetres, 3 m away": Case("tank", (3.0, 0.0, 0.0), 0.01, factor=1.08),
    "trousers too small by 8%, z up": Case("trousers", "floor", up="z", factor=0.92),
    "shorts too small by 8%, back to front": Case("shorts", "centre", turn=180.0, factor=0.92),
    "shorts too small by 8%, where they belong": Case("shorts", unit=0.001, angle=30.0, shape=(2, 2.0), factor=0.92),
    "tank too small by 8%, in inches": Case("tank", "floor", 0.0254, "z", 90.0, 30.0, (2, 2.0), 0.92),
    "dress too large by 8%, in inches, 3 m away": Case("dress", (0.0, 0.0, 3.0), 0.0254, "z", 90.0, 45.0, factor=1.08),
}


@pytest.mark.parametrize(
    "name", [*(pytest.param(name, marks=pytest.mark.slow) for name in list(SIZES)[:-2]), *list(SIZES)[-2:]]
)
def test_another_size_comes_back_too(capsys: pytest.CaptureFixture[str], name: str) -> None:
    assert bring_back(SIZES[name], capsys)[0] == "right"


def test_sleeves_tell_no_size(capsys: pytest.CaptureFixture[str]) -> None:
    """Room over the chest and a size less are alike: a long-sleeved top keeps its size, which is among those that fit.

    One that fits in no size near its own is too small.
    """
    assert bring_back(Case("longsleeve", "floor", up="z", turn=270.0, shape=(1, 2.0), factor=1.07), capsys)[0] == "told"
    small = Case("longsleeve", "centre", 0.0254, angle=30.0, shape=(1, -2.0), factor=0.92)
    assert bring_back(small, capsys)[0] == "refused"
    assert main(["prepare", "garment=g.obj", *small.words, "output=small.npz"]) == 2
    assert "it is too small: it fits at 1.0" in capsys.readouterr().err


def test_a_loose_skirt_is_no_quarter_of_its_size(capsys: pytest.CaptureFixture[str]) -> None:
    """In decimetres it fits the trunk loosely, in inches closely around an arm: neither is sure."""
    assert bring_back(Case("skirt", unit=0.1, turn=270.0, shape=(4, -2.0), factor=1.07), capsys)[0] == "refused"


def test_the_unit_alone_is_named_only_where_the_garment_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    """A place that the search finds elsewhere once it knows the unit is not the file's."""
    garment, body = load_garment("tank"), _default()
    file = replace(garment, rest_pos=1000.0 * garment.rest_pos)
    offsets = {"scale=0.001": np.zeros(3), None: np.array([0.0, 0.3, 0.0])}
    for key, offset in offsets.items():
        found = FoundFit(Placement(0.001, "y", 0.0, offset), 0.7, 0.1)
        monkeypatch.setattr(placing, "find_place", lambda *words, found=found: found)
        assert placing.unit_alone(file, body, np.zeros(10)) == key


def test_prepare_resizes_nothing_unasked(capsys: pytest.CaptureFixture[str]) -> None:
    """It says that another size lies closer; a size that is asked for is kept, and what becomes of rest lengths is said."""
    case = Case("tank", factor=1.08)
    _, command = bring_back(case, capsys)
    (scale,) = [word for word in shlex.split(command) if word.startswith("scale=")]
    file = load_garment("g.obj").rest_pos
    assert main(["prepare", "garment=g.obj", "output=alone.npz"]) == 0
    assert "lies around the body more closely at 0.9" in capsys.readouterr().err
    assert np.ptp(load_garment("alone.npz").rest_pos, axis=0) == pytest.approx(np.ptp(file, axis=0), rel=1e-3)
    assert main([*shlex.split(command)[1:], "output=asked.npz"]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    assert f"rest lengths: {scale.removeprefix('scale=')} times the file's" in said.out
    resized = np.ptp(load_garment("asked.npz").rest_pos, axis=0) / np.ptp(file, axis=0)
    assert resized == pytest.approx(float(scale.removeprefix("scale=")), rel=1e-3)


@pytest.mark.parametrize(
    "name", ["tshirt", *(pytest.param(name, marks=pytest.mark.slow) for name in (*GARMENTS[1:], "shorts"))]
)
@pytest.mark.parametrize("factor", [0.96, 1.0, 1.05])
def test_a_cut_that_is_a_little_wider_or_tighter_keeps_its_size(body: Body, name: str, factor: float) -> None:
    garment, pos, _ = truth(Case(name))
    middle = pos.mean(axis=0)
    found = find_place(replace(garment, rest_pos=middle + factor * (pos - middle)), body, np.zeros(10), AskedFit(), None)
    assert found.resized is None
    assert found.placement.scale == 1.0


@pytest.mark.slow
def test_the_table_of_sizes(capsys: pytest.CaptureFixture[str]) -> None:
    """Every size that is proposed is within 1.5% of the garment's own; the rest are refused, or kept and told."""
    cases = sizes_table()
    results = [bring_back(case, capsys)[0] for case in cases]
    fine = ("right", "refused", "told")
    wrong = {str(case): result for case, result in zip(cases, results, strict=True) if result not in fine}
    with capsys.disabled():
        counts = {word: results.count(word) for word in fine}
        print(f"\n{len(cases)} garments of another size: {counts}, {wrong}")
    assert wrong == {}
    assert results.count("right") >= 0.55 * len(cases)


@pytest.mark.slow
def test_the_table_of_misplacements(capsys: pytest.CaptureFixture[str]) -> None:
    """At least 95% come back within 1 cm and 3 degrees; the rest are refused, by inspect and prepare alike."""
    cases = table()
    results = [bring_back(case, capsys)[0] for case in cases]
    wrong = {str(case): result for case, result in zip(cases, results, strict=True) if result not in ("right", "refused")}
    with capsys.disabled():
        print(f"\n{len(cases)} misplacements: {results.count('right')} right, {results.count('refused')} refused, {wrong}")
    assert len(cases) >= 60
    assert wrong == {}
    assert results.count("right") >= 0.95 * len(cases)


def test_what_fits_nowhere_or_twice_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    """Flat cloth, and a T-shirt three times too wide, are told from garments that lie elsewhere."""
    garment, pos, _ = truth(Case("tshirt"))
    for name, bad in {"flat": pos * [1.0, 1.0, 0.001], "wide": pos * [1.0, 1.0, 6.0]}.items():
        write_obj(Path(f"{name}.obj"), bad, garment.faces)
        assert main(["inspect", f"{name}.obj", "--json"]) == 1
        finding = json.loads(capsys.readouterr().out)["files"][0]
        assert finding["command"] is None
        assert any("no place" in entry["problem"] for entry in finding["problems"])
        assert main(["prepare", f"garment={name}.obj", "output=bad.npz"]) == 2
        assert not Path("bad.npz").exists()
        capsys.readouterr()


MESHES = {
    "tank, 3 m away, in centimetres": Case("tank", (3.0, 0.0, 0.0), 0.01),
    "trousers, z up, back to front": Case("trousers", "centre", up="z", turn=180.0),
    "T-shirt of another floor, in inches": Case("tshirt", "floor", 0.0254),
}


@pytest.mark.parametrize("name", MESHES)
def test_the_command_for_a_mesh_body(capsys: pytest.CaptureFixture[str], body: Body, name: str) -> None:
    """The mesh stands where it likes: two metres aside, with its feet on y = 0."""
    aside = np.array([2.0, -body.v_template[:, 1].min(), 0.5])
    write_obj(Path("hero.obj"), body.v_template + aside, body.faces)
    garment, pos, placement = truth(MESHES[name])
    file = (pos - placement.offset) @ placement.rotation / placement.scale
    write_obj(Path("g.obj"), file, garment.faces)
    main(["inspect", "g.obj", "body=hero.obj", "--json"])
    command = json.loads(capsys.readouterr().out)["files"][0]["command"]
    assert "body=hero.obj" in command
    assert main([*shlex.split(command)[1:], "output=g.npz"]) == 0
    assert np.linalg.norm(load_garment("g.npz").rest_pos - pos - aside, axis=1).mean() < NEAR


def cape() -> tuple[np.ndarray, np.ndarray]:
    """A half ring of cloth (V, 3) behind the back, from the shoulders to the knees, and its faces: a sheet."""
    rows = columns = 20
    down, along = np.divmod(np.arange((rows + 1) * (columns + 1)), columns + 1)
    angle, down = np.pi * (1 + along / columns), down / rows
    places = [(0.2 + 0.15 * down) * np.cos(angle), 0.6 - 0.95 * down, (0.13 + 0.18 * down) * np.sin(angle) - 0.03]
    first = np.flatnonzero((along < columns) & (np.arange(len(along)) < rows * (columns + 1)))
    corners = first[:, None] + [0, 1, columns + 2, columns + 1]
    return np.stack(places, axis=1), np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])


def test_a_sheet_far_from_a_mesh_body_does_not_fit_until_it_is_moved(capsys: pytest.CaptureFixture[str], body: Body) -> None:
    """The printed command carries the way; without it prepare warns as a rollout does."""
    write_obj(Path("hero.obj"), body.v_template, body.faces)
    pos, faces = cape()
    write_obj(Path("cape.obj"), pos + [3.0, 0, 0], faces)
    assert main(["inspect", "hero.obj", "cape.obj", "body=hero.obj"]) == 1
    said = capsys.readouterr().out
    assert "! they do not fit: the garment is away from the body: its middle vertex is 2." in said
    assert "  they fit" not in said
    main(["inspect", "hero.obj", "cape.obj", "body=hero.obj", "--json"])
    report = json.loads(capsys.readouterr().out)
    assert not report["fit"]["fits"]
    assert main(["prepare", "garment=cape.obj", "body=hero.obj", "output=still.npz"]) == 0
    assert "warning: garment 'cape' is away from the body" in capsys.readouterr().err
    command = shlex.split(report["files"][1]["command"])
    assert [word for word in command if word.startswith("offset=")] == ["offset=[-3.0,0.0,0.0]"]
    assert main([*command[1:], "output=back.npz"]) == 0
    assert capsys.readouterr().err == ""
    assert main(["inspect", "hero.obj", "back.npz", "body=hero.obj"]) == 0
    assert "  they fit" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["default", "hero.obj"])
def test_a_cape_behind_the_back_stays_there(capsys: pytest.CaptureFixture[str], body: Body, name: str) -> None:
    """It lies around the body: neither turned nor moved, whichever body it is."""
    write_obj(Path("hero.obj"), body.v_template, body.faces)
    pos, faces = cape()
    write_obj(Path("cape.obj"), pos, faces)
    assert main(["prepare", "garment=cape.obj", f"body={name}", "output=cape.npz"]) == 0
    assert "turned" not in capsys.readouterr().out
    np.testing.assert_allclose(load_garment("cape.npz").rest_pos, pos, atol=1e-4)


def test_the_command_names_the_body(capsys: pytest.CaptureFixture[str], body: Body) -> None:
    """A garment that is measured against another body is prepared for that one."""
    other = replace(body, v_template=body.shaped(np.array([2.0]))[0])
    zeros = {"posedirs": np.zeros((len(other.v_template), 3, 207))}
    tree = np.stack([np.array(other.parents), np.arange(other.num_joints)])
    np.savez(
        "tall.npz", v_template=other.v_template, shapedirs=other.shapedirs, J_regressor=other.joint_regressor,
        weights=other.weights, kintree_table=tree, f=other.faces, **zeros,
    )  # fmt: skip
    case = Case("tank", (1.0, 0.0, 0.0), shape=(0, 2.0))
    garment, pos, placement = truth(case)
    write_obj(Path("g.obj"), pos - placement.offset, garment.faces)
    main(["inspect", "g.obj", "body=tall.npz", "--json"])
    command = json.loads(capsys.readouterr().out)["files"][0]["command"]
    assert "body=tall.npz" in command
    assert main([*shlex.split(command)[1:], "output=g.npz"]) == 0
    assert np.linalg.norm(load_garment("g.npz").rest_pos - pos, axis=1).mean() < NEAR
