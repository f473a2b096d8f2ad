"""``hood fit`` and ``hood.fit``: parameters of a small sheet found again, files of frames, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import hood
from hood.app import fit as fitting
from hood.app.settings.rollout_settings import RolloutSettings, overrides
from hood.cli.main import main
from hood.evaluation.fitting import Observed
from hood.mesh.shapes import grid

FRAMES = 8
TRUTH = {"lame_mu": 4e3, "bending_stiffness": 3e-4}


@pytest.fixture(scope="module")
def sheet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sheet") / "sheet.obj"
    pos, faces = grid(5, 5, 0.3)
    trimesh.Trimesh(pos + [0, 1, 0], faces, process=False).export(path)
    return path


@pytest.fixture(scope="module")
def seen(sheet: Path) -> np.ndarray:
    """(T, V, 3) m of the truth."""
    keys: dict[str, Any] = {"stepper": "newton", "metrics": "none", "solver": {"target_rg": 1e-5}, "num_frames": FRAMES}
    return np.stack([frame.world_pos.numpy() for frame in hood.simulate(**scene(sheet), material=TRUTH, **keys)])


def scene(sheet: Path) -> dict[str, Any]:
    return {"garment": str(sheet), "body": "none", "pins": [0, 4], "settle": 0, "wind": 0}


def words(sheet: Path) -> list[str]:
    return [f"garment={sheet}", "body=none", "pins=[0,4]", "settle=0", "wind=0"]


def as_folder(folder: Path, frames: Any, faces: Any = None) -> Path:
    folder.mkdir()
    for number, pos in enumerate(frames):
        made = trimesh.PointCloud(pos) if faces is None else trimesh.Trimesh(pos, faces, process=False)
        made.export(folder / f"frame_{number:03d}.ply")
    return folder


def test_a_fabric_is_found_again_and_its_files_say_so(sheet: Path, seen: np.ndarray, tmp_path: Path) -> None:
    told: list[str] = []
    guess = {name: 4.0 * value for name, value in TRUTH.items()}
    keys = {"guess": guess, "parameters": [*TRUTH], "windows": [0.5, 1.0], "output": str(tmp_path / "out")}
    found = hood.fit(seen, tell=told.append, **keys, **scene(sheet))
    assert found["converged"]
    for name, value in TRUTH.items():
        one = found["parameters"][name]
        assert one["value"] == pytest.approx(value, rel=2e-3), name
        assert one["seen"]
        assert one["low"] <= value * 1.002
        assert one["high"] >= value * 0.998
    assert json.loads((tmp_path / "out" / "fit.json").read_text()) == found
    assert {path.name for path in (tmp_path / "out").glob("*.png")} == {"beside.png", "loss.png"}
    assert any(line.startswith("lame_mu: 4000 Pa (95%: ") for line in told)
    assert f"material.lame_mu={found['parameters']['lame_mu']['value']:.6g}"[:20] in found["command"]
    assert found["history"][-1]["rms"] < 1e-3 * found["history"][0]["rms"]


def test_without_air_only_ratios_are_seen(sheet: Path, seen: np.ndarray) -> None:
    """Weight, inertia and elastic forces scale together: density times 2 with stiffness times 2 is the same motion."""
    told: list[str] = []
    names = ["density", "lame_mu"]
    airless = {**scene(sheet), "wind": None, "material": {**TRUTH, "lame_lambda": 100.0}}
    found = hood.fit(seen, parameters=names, noise=2e-2, windows=[1.0], tell=told.append, **airless)
    assert not any(found["parameters"][name]["seen"] for name in names) or any("only the ratio" in line for line in told)
    assert any("density: not seen in this motion" in line for line in told)


def test_points_without_correspondence(sheet: Path, seen: np.ndarray, tmp_path: Path) -> None:
    _, faces = grid(5, 5, 0.3)
    rng = np.random.default_rng(0)
    clouds = [(rng.dirichlet((1, 1, 1), 80)[:, :, None] * pos[faces[rng.integers(len(faces), size=80)]]).sum(1) for pos in seen]
    folder = as_folder(tmp_path / "clouds", clouds)
    asked = [f"observed={folder}", "points=true", "parameters=[lame_mu]", "guess={lame_mu:12000}", f"output={tmp_path / 'out'}"]
    assert main(["fit", *asked, "material.bending_stiffness=3e-4", *words(sheet)]) == 0
    found = json.loads((tmp_path / "out" / "fit.json").read_text())["parameters"]["lame_mu"]
    assert found["value"] == pytest.approx(4e3, rel=0.02)
    assert (tmp_path / "out" / "beside.png").stat().st_size > 5000


def test_size_and_wind_and_frames_that_lack_vertices(sheet: Path, tmp_path: Path) -> None:
    keys = {**scene(sheet), "wind": [1.0, 0.0, -2.0], "size": 1.05}
    steps = hood.simulate(**keys, stepper="newton", metrics="none", num_frames=FRAMES)
    frames = np.stack([frame.world_pos.numpy() for frame in steps])
    frames[3, 7] = np.nan
    out = str(tmp_path / "out")
    found = hood.fit(
        frames, parameters=["size", "wind_x"], **{**scene(sheet), "wind": [0.0, 0.0, -2.0]}, windows=[1.0], output=out
    )
    values = {name: one["value"] for name, one in found["parameters"].items()}
    assert values == pytest.approx({"size": 1.05, "wind_x": 1.0}, abs=0.05)
    assert "wind=[" in found["command"]
    assert found["command"].endswith(",0.0,-2.0]")  # what is not fitted stays
    assert values["size"] == pytest.approx(1.05, abs=2e-3)


def test_a_search_that_is_cut_short_ends_with_3_and_an_interrupted_one_keeps_the_best(
    sheet: Path, seen: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, faces = grid(5, 5, 0.3)
    folder = as_folder(tmp_path / "seen", seen, faces)
    asked = [f"observed={folder}", "parameters=[lame_mu]", "guess={lame_mu:20000}", f"output={tmp_path / 'out'}", *words(sheet)]
    assert main(["fit", *asked, "most_steps=1", "windows=[1]"]) == 3
    assert not json.loads((tmp_path / "out" / "fit.json").read_text())["converged"]
    residual, calls = fitting._Scene.residual, []

    def stopped(self: Any, values: Any, count: int) -> np.ndarray:
        calls.append(values)
        if len(calls) > 5:
            raise KeyboardInterrupt
        return residual(self, values, count)

    monkeypatch.setattr(fitting._Scene, "residual", stopped)
    assert main(["fit", *asked]) == 130
    kept = json.loads((tmp_path / "out" / "fit.json").read_text())
    assert kept["interrupted"]
    assert 4e3 < kept["parameters"]["lame_mu"]["value"] < 2e4


def test_worn_cloth_starts_from_the_first_frame_that_was_seen() -> None:
    keys: dict[str, Any] = {"garment": "tank", "sequence": "plie", "num_frames": 3}
    steps = hood.simulate(**keys, stepper="newton", metrics="none")
    frames = np.stack([frame.world_pos.numpy() for frame in steps])
    noisy = frames + 2e-3 * np.random.default_rng(0).normal(size=frames.shape)
    settings = RolloutSettings.from_words(["stepper=newton", "metrics=none", "video=none", *overrides(keys)])
    scene = fitting._Scene(settings, Observed([*noisy], False), 0, 1, True)
    scene.check({})
    begun = next(cloth for _, cloth, _ in scene.frames({}, 2))
    off, noise = (np.linalg.norm(one - frames[0], axis=1) for one in (begun, noisy[0]))
    assert np.sqrt((off**2).mean()) < 0.5 * np.sqrt((noise**2).mean())
    assert len(scene.residual({}, 3)) == 2 * frames.shape[1]
    noisy[0, 5] = np.nan
    scene = fitting._Scene(settings, Observed([*noisy], False), 0, 1, True)
    scene.check({})
    assert not scene.from_first


@pytest.mark.parametrize(
    ("words", "expected"),
    [(["parameters=[size]"], False), (["parameters=[size,lame_mu]"], True), (["parameters=[size]", "from_first=true"], True)],
)
def test_a_fabric_is_fitted_from_the_first_frame_and_a_size_is_not(
    words: list[str], expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Asked(Exception):
        pass

    def scene(*arguments: Any) -> None:
        raise Asked(arguments[-1])

    monkeypatch.setattr(fitting, "_Scene", scene)
    with pytest.raises(Asked) as asked:
        fitting.run_fit(["garment=tank", *words], np.zeros((3, 5, 3)))
    assert asked.value.args == (expected,)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("parameters=[mu]", "unknown parameter 'mu'"),
        ("parameters=[]", "parameters=[]: nothing is fitted"),
        ("bounds={lame_mu:[9,1]}", "bounds: lame_mu is [9,1]; give the least value, then the greatest"),
        ("guess={lame_mu:1e9}", "guess: lame_mu is 1e+09, outside its bounds 100 to 1e+07"),
        ("priors={size:[1,0.1]}", "priors: unknown parameter 'size'"),
        ("priors={lame_mu:3}", "priors: lame_mu is 3; give two numbers"),
        ("windows=[0.5]", "windows=[0.5]: give shares of the frames, above 0, the last one 1"),
        ("noise=-1", "noise=-1: give metres above 0"),
        ("huber=0", "huber=0: give metres above 0"),
        ("whole=true", "whole=true: is for points=true"),
        ("from_first=true", "from_first=true: is for worn cloth of which all vertices were seen in frame 0"),
        ("every=0", "every=0: must be at least 1"),
        ("refine_mesh=1", "refine_mesh=1: hood fit has no use for it"),
        ("garmnt=tank", "did you mean 'garment'"),
        ("observed=null", "observed: nothing was observed"),
        ("observed=nowhere", "nowhere"),
        ("material=silk_habotai", "lame_mu is no number of this fabric"),
    ],
)
def test_what_cannot_be_fitted_is_refused_in_a_sentence(
    word: str, message: str, sheet: Path, seen: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = as_folder(tmp_path / "seen", seen[:2])
    out = tmp_path / "out"
    assert main(["fit", f"observed={folder}", "parameters=[lame_mu]", *words(sheet), f"output={out}", word]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()[-1:]
    assert line.startswith("hood: error:")
    assert message in line
    assert not out.exists()


def test_frames_that_do_not_fit_are_refused(sheet: Path, seen: np.ndarray, tmp_path: Path) -> None:
    keys: dict[str, Any] = {"parameters": ["lame_mu"], "output": str(tmp_path / "out"), **scene(sheet)}
    with pytest.raises(ValueError, match="24 vertices a frame, the garment has 25; give the garment that was seen, or points"):
        hood.fit(seen[:, 1:], **keys)
    with pytest.raises(ValueError, match="frame 1 has 25 vertices, frame 0 has 24"):
        hood.fit([seen[0][1:], seen[1]], **keys)
    with pytest.raises(ValueError, match="frame 2 holds no point that is finite"):
        hood.fit(np.where(np.arange(FRAMES)[:, None, None] == 2, np.nan, seen), **keys)
    with pytest.raises(ValueError, match="frame 0 is 1e\\+03 times as large as the garment; give points in metres"):
        hood.fit(1e3 * seen, **keys)
    folder = as_folder(tmp_path / "seen", seen)
    (folder / "frame_003.ply").unlink()
    with pytest.raises(ValueError, match=r"there is no frame 3 between frame_000\.ply and frame_007\.ply"):
        hood.fit(folder, **keys)
    with pytest.raises(ValueError, match="its last frame is frame 3996 of the simulation, but"):
        hood.fit(np.tile(hood.load_garment("tank").rest_pos, (38, 1, 1)), parameters=["size"], garment="tank", every=108)
    assert not (tmp_path / "out").exists()
