"""Rollouts, ``hood prepare`` and ``hood inspect`` of files that are not one sheet do the same and say it."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from garment_kinds import (
    KINDS,
    avatar,
    button,
    clean,
    eyelet,
    front_places,
    joined,
    part,
    quarters,
    shell,
    write_mesh,
    write_objects,
)

from hood.app.notices import heard
from hood.app.scene.garment_files import read_garment
from hood.assets.body.load import load_body
from hood.assets.files.said import Doubt
from hood.assets.garment.garment import load_garment
from hood.assets.garment.record import Wanted
from hood.cli.inspect.findings import inspect_garment
from hood.cli.main import main
from hood.media.colouring import vertex_strain
from hood.mesh.topology import boundary_loops
from hood.rollouts.file.reader import RolloutData, read_rollout
from hood.rollouts.verdict.rule import judge_rollout

ROLLOUT = ("rollout", "stepper=newton", "num_frames=2", "video=none", "sheet=false", "output=run")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def run(path: Path | str, *words: str) -> tuple[RolloutData, list[str], list[Doubt]]:
    """A short rollout, what it warned about, and the doubts among that."""
    with heard(aloud=False) as said:
        assert main([*ROLLOUT, f"garment={path}", *words]) in (0, 3)
    return read_rollout("run/rollout.h5"), list(said), said.doubts


def inspect(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    capsys.readouterr()
    main(["inspect", *words, "format=json"])
    report: dict[str, Any] = json.loads(capsys.readouterr().out)
    return report


@pytest.fixture
def buttoned(tmp_path: Path) -> Path:
    return write_mesh(
        tmp_path / "buttoned.obj", joined(clean("tank"), *(button(*place) for place in front_places(clean("tank"))))
    )


def test_buttons_ride_in_every_frame_and_come_out_of_every_export(buttoned: Path) -> None:
    """As rigid bodies on the cloth beneath them, which moves as it does without them."""
    plain = run(write_mesh(Path("plain.obj"), clean("tank")), "metrics={fields:[rg]}")[0]
    data, _, doubts = run(buttoned, "formats=[obj,ply,glb,usd,pc2]", "metrics={fields:[rg]}")
    assert [doubt.kind for doubt in doubts] == ["garment"]
    count, riding = len(clean("tank")[0]), 4 * 26
    assert data.riding[0] == riding
    np.testing.assert_array_equal(data.cloth_pos[:, :count], plain.cloth_pos)
    np.testing.assert_array_equal(data.fields["rg"][:, :count], plain.fields["rg"])
    for number in range(4):
        rows = slice(count + 26 * number, count + 26 * (number + 1))
        lengths = [np.linalg.norm(pos[rows] - pos[rows].mean(axis=0), axis=1) for pos in (data.rest_pos, *data.cloth_pos)]
        np.testing.assert_allclose(lengths, np.tile(lengths[0], (3, 1)), atol=1e-6)
        middles = data.cloth_pos[:, rows].mean(axis=1)
        dist = np.linalg.norm(data.cloth_pos[:, :count] - middles[:, None], axis=2).min(axis=1)
        assert dist.max() < 0.03
    assert judge_rollout(data).sound == judge_rollout(plain).sound
    assert vertex_strain(data).shape == data.cloth_pos.shape[:2]
    for file in (*Path("run").rglob("*.obj"), *Path("run").rglob("*.ply")):
        mesh = trimesh.load(file, process=False)
        assert len(mesh.faces) in (len(data.cloth_faces), len(data.body_faces))
    names = {path.suffix for path in Path("run").rglob("*")}
    assert {".obj", ".ply", ".glb", ".usda", ".pc2"} & names >= {".obj", ".ply", ".glb", ".pc2"}


def test_buttons_ride_on_a_refined_mesh(buttoned: Path) -> None:
    data = run(buttoned, "refine_mesh=1")[0]
    assert data.refined is not None
    assert len(data.cloth_faces) == 4 * len(data.refined.faces) + data.riding[1]
    assert vertex_strain(data).shape == data.cloth_pos.shape[:2]
    assert np.isfinite(data.cloth_pos).all()


def test_buttons_are_kept_by_prepare(buttoned: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["prepare", f"garment={buttoned}", "output=b.npz"]) == 0
    assert "4 closed parts on the cloth" in capsys.readouterr().out
    garment = load_garment("b.npz")
    assert garment.riders is not None
    assert garment.riders.num_groups == 4
    data, said, _ = run("b.npz")
    assert data.riding == (4 * 26, 4 * 48)
    assert said == []


def test_a_shell_is_one_layer_and_keeps_its_thickness(capsys: pytest.CaptureFixture[str]) -> None:
    path = write_mesh(Path("shell.obj"), shell(clean("tank"), 2e-3))
    plain = run(write_mesh(Path("plain.obj"), clean("tank")))[0]
    data, _, doubts = run(path)
    np.testing.assert_array_equal(data.cloth_pos, plain.cloth_pos)
    assert "two layers 2.0 mm apart" in str(doubts[0])
    assert main(["prepare", f"garment={path}", "output=s.npz"]) == 0
    thick = load_garment("s.npz").thickness
    assert thick is not None
    np.testing.assert_allclose(thick, 2e-3, rtol=0.02)
    (found,) = inspect(capsys, str(path))["files"]
    assert found["facts"]["thickness [mm]"] == pytest.approx(2.0, abs=0.02)


def test_pins_of_panels_are_those_of_the_file() -> None:
    """Held vertices stay where they are, whatever numbers they have once the panels are sewn."""
    mesh = joined(*quarters(clean("tank"), 3e-3))
    path, top = write_mesh(Path("panels.obj"), mesh), np.argsort(mesh[0][:, 1])[-3:]
    data = run(path, f"pins={top.tolist()}".replace(" ", ""))[0]
    held = [int(np.argmin(np.linalg.norm(data.rest_pos - mesh[0][row], axis=1))) for row in top]
    heights = data.cloth_pos[:, held].mean(axis=1)[:, 1]
    assert len(data.rest_pos) == len(clean("tank")[0])
    assert np.ptp(heights) < 5e-3


def test_two_garments_of_a_file_are_an_outfit(tmp_path: Path) -> None:
    """Taken apart before frame 0, as two files are, and in the order that is asked for."""
    path = KINDS["two garments by o"].write(tmp_path)
    data, said, doubts = run(path, "layers=[skirt,tank]")
    assert data.attributes["garment"] == "tank+skirt"
    assert "holds 2 garments" in str(doubts[0])
    assert any("from the body outwards: skirt, tank" in sentence for sentence in said)
    assert set(data.still["piece"].tolist()) == {0, 1}
    for words in ((path, "objects=[skirt]"), (f"{path}:skirt",)):
        assert len(run(*words, "settle=paper", "num_frames=1")[0].rest_pos) == len(clean("skirt")[0])


def test_an_avatar_of_the_file_can_be_the_body(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_objects(tmp_path / "scene.obj", [("Avatar", avatar()), ("tank", clean("tank"))])
    data, _, doubts = run(path)
    assert len(data.rest_pos) == len(clean("tank")[0])
    assert f"body={path}:Avatar has it as the body" in str(doubts[0])
    data = run(path, f"body={path}:Avatar")[0]
    np.testing.assert_allclose(data.body_pos[0], avatar()[0], atol=1e-5)
    report = inspect(capsys, str(path), f"body={path}:Avatar")
    assert report["fit"]["fits"]
    assert main([*ROLLOUT, f"garment={path}", f"body={path}:Nobody"]) == 2
    assert "no object, group, material or part 'Nobody'; there are " in capsys.readouterr().err


def test_inspect_lists_what_is_in_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ring = eyelet(*front_places(clean("tank"))[0])
    path = write_objects(tmp_path / "all.obj", [("Avatar", avatar()), ("tank", clean("tank")), ("ring", ring)])
    (found,) = inspect(capsys, str(path))["files"]
    assert found["facts"]["object Avatar"].endswith("a body")
    assert found["facts"]["object tank"] == "1016 vertices, 0.4 × 0.64 × 0.27 m, cloth with 4 openings"
    assert found["facts"]["object ring"].endswith("a small thing such as a button")
    assert found["facts"]["riding vertices"] == len(ring[0])
    assert found["command"] == f"hood prepare garment={path}"
    (found,) = inspect(capsys, str(path), "objects=[tank,ring]", "small_parts=leave_out", "weld=0.002")["files"]
    assert found["command"] == f"hood prepare garment={path} 'objects=[tank,ring]' weld=0.002 small_parts=leave_out"


_FEW = ("panels 3 mm apart", "shell of 2 mm", "buttons", "a pocket", "two garments by o", "an avatar beside it")
_SPOKEN = [name for name, kind in KINDS.items() if kind.says]


@pytest.mark.parametrize("name", [pytest.param(name, marks=[] if name in _FEW else pytest.mark.slow) for name in _SPOKEN])
def test_inspect_promises_what_a_rollout_does(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One sentence, the same in both, with a way out where it rests on a guess."""
    path = KINDS[name].write(tmp_path)
    body = load_body()
    with heard(aloud=False) as said:
        read_garment(str(path), Wanted(), body.v_template, triangulate=True)
    told = " ".join(f"{what}; {fix}" for what, fix in inspect_garment(str(path), body, []).problems)
    for doubt in said.doubts:
        assert str(doubt).removeprefix(f"garment {path.stem!r}: ") in told
        assert "; " in str(doubt)
    assert KINDS[name].says in " ".join(said)


def test_a_part_that_falls_is_named_and_the_others_settle(tmp_path: Path) -> None:
    """A tube beside the feet goes back to where it was; the tank comes to rest."""
    pos, faces = clean("skirt")
    hoop = part((pos * [2.5, 0.3, 2.5], faces), np.ones(len(faces), dtype=bool))
    path = write_objects(tmp_path / "two.obj", [("tank", clean("tank")), ("hoop", hoop)])
    data, said, _ = run(path, "cloth_contact=off")
    (sentence,) = [one for one in said if "comes off the body" in one]
    assert "part 2 of 'hoop' (994 vertices from 1016 on, at [" in sentence
    plain = run(write_mesh(Path("plain.obj"), clean("tank")), "cloth_contact=off")[0]
    np.testing.assert_allclose(data.cloth_pos[0, :1016], plain.cloth_pos[0], atol=2e-3)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("weld=much",), "weld=much: give a number ≥ 0 or auto"),
        (("shells=thin",), "shells"),
        (("small_parts=fly",), "small_parts"),
        (("objects=[[a]]",), "objects="),
    ],
)
def test_other_values_are_refused(words: tuple[str, ...], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*ROLLOUT, "garment=tank", *words]) == 2
    assert told in capsys.readouterr().err


def sleeve_off(gap: float, *names: str, unit: float = 1.0) -> Path:
    """A long-sleeved top whose left sleeve is moved ``gap`` [m] away, in ``unit`` [m]."""
    mesh = clean("longsleeve")
    beyond = mesh[0][mesh[1]].mean(axis=1)[:, 0] > 0.24
    off, faces = part(mesh, beyond)
    top, sleeve = part((mesh[0] / unit, mesh[1]), ~beyond), ((off + [gap, 0.0, 0.0]) / unit, faces)
    if names:
        return write_objects(Path("named.obj"), list(zip(names, (top, sleeve), strict=True)))
    return write_mesh(Path("cut.obj"), joined(top, sleeve))


def test_a_sleeve_that_lies_at_its_armhole_is_sewn() -> None:
    garment = read_garment(str(sleeve_off(0.003)), Wanted(), load_body().v_template, False)
    assert len(garment.rest_pos) == len(clean("longsleeve")[0])
    assert garment.piece is None


@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_the_gap_is_told_in_metres(unit: float) -> None:
    with pytest.raises(ValueError, match="30 mm apart; weld=0.031 sews them"):
        read_garment(str(sleeve_off(0.03, unit=unit)), Wanted(), load_body().v_template, False)


@pytest.mark.parametrize("gap", [0.03, pytest.param(0.015, marks=pytest.mark.slow)])
def test_a_sleeve_that_is_cut_off_is_refused_with_what_sews_it(gap: float, capsys: pytest.CaptureFixture[str]) -> None:
    path, surface = sleeve_off(gap), load_body().v_template
    with pytest.raises(
        ValueError, match=f"'cut': part_1 and part_2 are .* {1e3 * gap:g} mm apart; weld=.* weld=none or"
    ) as caught:
        read_garment(str(path), Wanted(), surface, False)
    (word,) = re.findall(r"weld=[\d.]+", str(caught.value))
    for command in (ROLLOUT, ("prepare", "output=out.npz")):
        assert main([*command, f"garment={path}"]) == 2
    assert main(["inspect", str(path)]) == 1
    assert str(caught.value) in capsys.readouterr().out
    sewn = read_garment(str(path), Wanted(gap=float(word.removeprefix("weld="))), surface, False)
    assert [len(rims) for rims in (boundary_loops(sewn.faces), boundary_loops(clean("longsleeve")[1]))] == [4, 4]
    assert main(["prepare", f"garment={path}", word, "output=out.npz"]) == 0
    assert len(load_garment("out.npz").rest_pos) == len(sewn.rest_pos) == len(clean("longsleeve")[0])


@pytest.mark.parametrize(
    "wanted", [Wanted(sew=False), Wanted(objects=("part_1", "part_2")), Wanted(layered=True)], ids=["weld", "objects", "layers"]
)
def test_parts_that_are_asked_for_are_garments(wanted: Wanted) -> None:
    garment = read_garment(str(sleeve_off(0.03)), wanted, load_body().v_template, False)
    assert garment.name == "part_1+part_2"


def test_parts_with_names_are_garments() -> None:
    assert read_garment(str(sleeve_off(0.03, "top", "cuff")), Wanted(), load_body().v_template, False).name == "top+cuff"


def test_an_order_of_parts_says_that_they_are_garments() -> None:
    assert run(sleeve_off(0.03), "layers=[part_2,part_1]", "fail_on=nothing")[0].cloth_pos.shape[0] == 2


@pytest.mark.parametrize(("unit", "count"), [(1.0, 1), (0.01, 3)])
def test_vertices_that_stand_out_are_told_by_their_numbers(unit: float, count: int, capsys: pytest.CaptureFixture[str]) -> None:
    pos, faces = clean("tshirt")
    pos, pulled = pos.copy(), np.argsort(-pos[:, 2])[[0, 30, 60][:count]]
    pos[pulled] += [0.0, 0.0, 0.4]
    path = write_mesh(Path("thorn.obj"), (pos / unit, faces))
    who = f"vertex {pulled[0]} stands" if count == 1 else f"{count} vertices stand out of the mesh, vertex {pulled.min()}"
    with heard(aloud=False) as said:
        read_garment(str(path), Wanted(), load_body().v_template, False)
    (doubt,) = said.doubts
    assert doubt.kind == "garment"
    assert who in str(doubt)
    assert re.search(r"by 0\.(39|4|41) m, 12 times the edges", str(doubt))
    assert main(["inspect", str(path)]) == 1
    assert who in capsys.readouterr().out
    assert main(["prepare", f"garment={path}", "output=thorn.npz"]) == 0
    assert who in capsys.readouterr().out
