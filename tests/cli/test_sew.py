"""``hood sew``: the garment file, the sheet, the exit codes."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from sewing_patterns import skirt, write

import hood
from hood.assets.garment.garment import load_garment
from hood.assets.pattern.designs import DESIGNS, draft
from hood.assets.pattern.measures import measure_body
from hood.cli.main import main
from hood.cli.sew import near_folds
from hood.mesh.flat import edge_lengths
from hood.mesh.topology import unique_edges


@pytest.mark.usefixtures("compiled_layers")
def test_a_skirt_from_its_pattern_to_a_rollout(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("PIL")
    path, target = write(tmp_path / "skirt.json", skirt()), tmp_path / "out" / "skirt.npz"
    assert main(["sew", str(path), "edge=0.05", "material=wool_suiting", f"output={target}"]) == 0
    text = capsys.readouterr().out
    assert "2 panels, 2 stitches" in text
    assert "waist=held holds a waist instead" in text
    assert target.with_suffix(".png").stat().st_size > 10_000
    garment = load_garment(target)
    assert garment.flat is not None
    assert not garment.pinned.any()
    assert garment.elastic is not None
    assert garment.elastic.min() == pytest.approx(0.85)
    assert set(garment.panels or {}) == {"front", "back"}
    garment = replace(garment, elastic=None)
    scene = hood.build_scene(garment, hood.load_body(), hood.load_sequence("plie"))
    flat = torch.as_tensor(garment.flat[:, 1:] - garment.flat[:, :1])
    edges = torch.as_tensor(unique_edges(garment.faces))
    lengths = edge_lengths(flat, torch.as_tensor(garment.faces), edges)
    assert float((scene.cloth.rest_length.double() / lengths - 1.0).abs().max()) < 1e-3
    for worn, most in ((garment, 0.1), (load_garment(target), 0.25)):  # elastic is stretched where it is worn
        frames = list(hood.simulate(worn, "plie", num_frames=4))
        assert max(frame.metrics["strain_p99"] for frame in frames) < most


@pytest.mark.usefixtures("compiled_layers")
def test_what_is_not_sewn_well_is_kept_for_a_look(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, target = write(tmp_path / "narrow.json", skirt(waist=50, hem=56)), tmp_path / "narrow.npz"
    assert main(["sew", str(path), "edge=0.06", "pose=tpose", "sheet=none", f"output={target}"]) == 3
    text = capsys.readouterr().out
    assert "not sewn: " in text
    assert "it is stretched by" in text
    assert not target.exists()
    assert len(load_garment(target.with_suffix(".unsewn.obj")).faces) > 100


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "no file is given: write one"),
        (["a.json", "b.json"], "2 files are given"),
        (["none.json"], "no such file"),
        (["skirt.json", "edge=9"], "edge=9: give a number from 0.004 to 0.1"),
        (["skirt.json", "waist=pinned"], "waist=pinned: give a number from 0.2 to 2, auto or held"),
        (["skirt.json", "gathers=true"], "gathers=true: give a number"),
        (["skirt.json", "pose=run"], "pose=run: give tpose, apose"),
        (["skirt.json", "output=a.obj"], "output=a.obj: garments are .npz files"),
        (["skirt.json", "sheet=a.jpg"], "sheet=a.jpg: sheets are .png files"),
        (["skirt.json", "material=steel"], "unknown material 'steel'"),
        (["skirt.json", "material.density=-1"], "density"),
        (["broken.json"], "not JSON"),
        (["design:tshrt"], "unknown design 'tshrt': did you mean 'tshirt'"),
        (["design:"], "unknown design '': known are tank"),
        (["design:skirt", "design={flair:0.5}"], "design:skirt: unknown option 'flair': did you mean 'flare (0 to 1.2)'"),
        (["design:skirt", "design={flare:9}"], "design:skirt: flare is 9; give a number from 0 to 1.2"),
        (["design:skirt", "design=wide"], "design=wide: give options in braces"),
        (["skirt.json", "design={flare:0.5}"], "design={flare:0.5}: give options in braces, hood sew design:tshirt"),
        (["design:skirt", "pattern=skirt.txt"], "pattern=skirt.txt: patterns are .json files"),
    ],
)
def test_mistakes_are_told_in_a_line(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "skirt.json", skirt())
    (tmp_path / "broken.json").write_text("{")
    assert main(["sew", *words]) == 2
    assert message in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["broken.json", "skirt.json"]


def test_panels_stand_in_the_file(tmp_path: Path) -> None:
    """The warp of a panel is its y."""
    path, target = write(tmp_path / "skirt.json", skirt()), tmp_path / "skirt.npz"
    assert main(["sew", str(path), "edge=0.08", "sheet=none", f"output={target}"]) == 0
    garment = load_garment(target)
    scene = hood.build_scene(garment, hood.load_body(), hood.load_sequence("plie"), hood.Material(warp=3.0))
    assert garment.flat is not None
    assert scene.cloth.grain is not None
    warp = np.einsum("fi,fix->fx", scene.cloth.grain.double().numpy(), garment.flat[:, 1:] - garment.flat[:, :1])
    assert float(np.degrees(np.abs(np.arctan2(warp[:, 0], warp[:, 1]))).max()) < 1.0


@pytest.mark.usefixtures("compiled_layers")
def test_a_design_is_sewn_and_its_pattern_can_be_sewn_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target, specification = tmp_path / "mini.npz", tmp_path / "patterns" / "mini.json"
    words = ["edge=0.05", "sheet=none", f"output={target}"]
    assert main(["sew", "design:skirt", "design={length:0.35,flare:0.2}", f"pattern={specification}", *words]) == 0
    assert f"written: {specification}" in capsys.readouterr().out
    first = load_garment(target)
    assert main(["sew", str(specification), *words]) == 0
    again = load_garment(target)
    assert first.flat is not None
    assert again.flat is not None
    assert (len(again.rest_pos), len(again.faces)) == (len(first.rest_pos), len(first.faces))
    areas = [np.abs(np.linalg.det(one.flat[:, 1:] - one.flat[:, :1])).sum() for one in (first, again)]
    assert areas[1] == pytest.approx(areas[0], rel=1e-6)


@pytest.mark.usefixtures("compiled_layers")
def test_a_zip_closes_a_front_and_is_opened(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "gilet.npz"
    assert main(["sew", "design:gilet", "design={tube:0.15}", "edge=0.05", "sheet=none", f"output={target}"]) == 0
    assert "front_zip: " in capsys.readouterr().out
    garment = load_garment(target)
    pairs = (garment.fasteners or {})["front_zip"]
    assert len(pairs) > 8
    apart = {}
    for events in ([], [{"frame": 0, "open": "front_zip"}]):
        *_, last = hood.simulate(garment, "walk_brisk", num_frames=6, events=events)
        pos = last.world_pos.numpy()
        apart[len(events)] = np.linalg.norm(pos[pairs[:, 0]] - pos[pairs[:, 1]], axis=1)
    assert apart[0].max() < 7e-3
    assert apart[1].max() > 1e-2


@pytest.mark.usefixtures("compiled_layers")
def test_any_seam_is_closed_by_a_fastener_and_opened(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, target = skirt(), tmp_path / "skirt.npz"
    content["pattern"]["stitches"][0][1]["hood"] = {"fastener": "side_zip"}
    words = [str(write(tmp_path / "skirt.json", content)), "edge=0.06", "sheet=none", f"output={target}"]
    assert main(["sew", *words]) == 0
    assert "side_zip: " in capsys.readouterr().out
    pairs = (load_garment(target).fasteners or {})["side_zip"]
    events = [{"frame": 2, "open": "side_zip"}]
    frames = [frame.world_pos.numpy() for frame in hood.simulate(target, "walk_brisk", num_frames=8, events=events)]
    gaps = [np.linalg.norm(pos[pairs[:, 0]] - pos[pairs[:, 1]], axis=1).max() for pos in frames]
    assert gaps[1] < 1.2e-2
    assert gaps[-1] > 2.0 * gaps[1], gaps


def test_the_help_names_every_design(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sew", "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    listed = re.search(r"NAME one of ([\w, ]+);", text)
    assert listed is not None
    assert re.findall(r"\w+", listed[1].replace(" or ", ", ")) == list(DESIGNS)


def test_pleats_that_a_mesh_does_not_resolve_are_told() -> None:
    """Flaps of box pleats are 22 mm wide in the middle of the skirt, those of knife pleats twice that."""
    body = hood.load_body()
    vertices, joints = body.shaped([0.0])
    measures = measure_body(vertices, body.faces, joints)
    box, knife = (draft("pleated", measures, {"pleat": pleat}) for pleat in ("box", "knife"))
    assert near_folds(box, 0.035) == ["folds 22 mm apart are strained by edges of 35 mm; edge=0.022 resolves them"]
    assert not near_folds(box, 0.02)
    assert not near_folds(knife, 0.035)
    assert not near_folds(draft("circle", measures), 0.1)
