"""What the add-on for Blender tells hood: its command is one that hood takes, its fabrics and keys are those that hood has."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from blender.hood_blender import command, finding, state
from blender.hood_blender.fault import REPAIRS, BakeError
from hood import __version__
from hood.app.plan_file import rollout_config
from hood.app.settings.compose import options
from hood.app.setup import check_config

ADDON = Path(command.__file__).parent
TWO = command.Request(
    (command.Garment("slip", "silk"), command.Garment("coat", "linen", (("coat__0_a", "linen"), ("coat__1_b", "denim")))),
    num_frames=11,
    fps=25.0,
    samples=2,
    gravity=1.62,
    wind=(1.0, 0.0, -2.5),
    pinned=True,
)


def test_the_fabrics_are_those_of_hood() -> None:
    assert sorted(command.FABRICS) == sorted(options("material"))
    assert command.FABRICS[0] == "default"


def test_the_words_are_a_command_of_hood() -> None:
    first, *words = command.words_of(TWO)
    assert first == "rollout"
    config = rollout_config(words)
    check_config(config)
    assert list(config.garment) == ["garments/slip.obj", "garments/coat.obj"]
    assert list(config.layers) == ["slip", "coat"]
    assert (config.fps, config.output_fps, config.num_frames) == (50, 25, 21)
    assert dict(config.fabrics) == {"coat__0_a": "linen", "coat__1_b": "denim"}
    assert list(config.wind) == [1.0, 0.0, -2.5]
    assert config.gravity == 1.62
    assert config.pins == "pins.json"


@pytest.mark.parametrize("quality", [name for name, _, _, _ in command.QUALITIES])
@pytest.mark.parametrize("repair", [None, *REPAIRS])
def test_qualities_and_repairs_are_keys_of_hood(quality: str, repair: str | None) -> None:
    more = () if repair is None else REPAIRS[repair][1]
    words = command.words_of(replace(TWO, quality=quality, more=more))[1:]
    check_config(rollout_config(words))
    assert len({word.partition("=")[0] for word in words}) == len(words)
    assert set(more) <= set(words)


def test_a_garment_of_another_fabric_is_named_and_one_alone_is_the_material() -> None:
    plain = command.Request((command.Garment("a", "silk"), command.Garment("b", "denim")), 3, 24.0)
    words = command.words_of(plain)
    assert "material=silk" in words
    assert "fabrics={b:denim}" in words
    assert "pins=none" in words
    alone = command.words_of(replace(plain, garments=plain.garments[:1]))
    assert not any(word.startswith(("fabrics", "layers", "wind", "output_fps")) for word in alone)


def test_words_of_the_user_count_last() -> None:
    words = command.words_of(replace(TWO, more=("fps=30", "damping=0.01")))
    assert words.count("fps=30") == 1
    assert "fps=50" not in words
    assert "damping=0.01" in words


def test_the_manifest_is_one_that_blender_takes() -> None:
    manifest = tomllib.loads((ADDON / "blender_manifest.toml").read_text(encoding="utf-8"))
    assert manifest["id"] == ADDON.name
    assert manifest["type"] == "add-on"
    assert manifest["blender_version_min"] == "4.2.0"
    assert len(manifest["tagline"]) <= 64
    assert not manifest["tagline"].endswith(".")
    assert manifest["license"] == ["SPDX:Apache-2.0"]
    assert all(len(reason) <= 64 and not reason.endswith(".") for reason in manifest["permissions"].values())
    assert manifest["version"] == __version__


def test_the_version_of_hood_is_checked() -> None:
    assert finding.check_version(f"hood {__version__} (hood-cloth)\n", "hood") == __version__
    with pytest.raises(BakeError, match=r"hood 0\.0\.9, the add-on needs 0\.1\.0 or newer; press Install hood"):
        finding.check_version("hood 0.0.9 (hood-cloth)", "hood")
    with pytest.raises(BakeError, match="x: is no hood \\(No module named hood\\); name hood"):
        finding.check_version("Python\nNo module named hood", "x")


def test_hood_is_found_where_the_user_says_then_installed_then_on_the_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("python3", "hood"):
        (tmp_path / name).write_text("#!/bin/sh\n")
        (tmp_path / name).chmod(0o755)
    own = tmp_path / "venv"
    assert finding.find_hood(str(tmp_path / "python3"), own) == [str(tmp_path / "python3"), "-m", "hood"]
    assert finding.find_hood(str(tmp_path / "hood"), own) == [str(tmp_path / "hood")]
    monkeypatch.setenv("PATH", str(tmp_path))
    assert finding.find_hood("", own) == [str(tmp_path / "hood")]
    python = finding.python_of(own)
    python.parent.mkdir(parents=True)
    python.write_text("")
    assert finding.find_hood("", own) == [str(python), "-m", "hood"]
    with pytest.raises(BakeError, match="nowhere: no such program"):
        finding.find_hood("nowhere", own)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(BakeError, match="hood is not installed; press Install hood"):
        finding.find_hood("", tmp_path / "empty")


def test_an_installation_fetches_from_what_the_user_names(tmp_path: Path) -> None:
    own = tmp_path / "venv"
    wheel = tmp_path / "hood_cloth-0.1.0-py3-none-any.whl"
    wheel.write_text("")
    code = tmp_path / "code"
    code.mkdir()
    (code / "pyproject.toml").write_text("")
    for source, last in (
        ("https://example.org/simple", ["--index-url", "https://example.org/simple", finding.PACKAGE]),
        (str(wheel), [str(wheel)]),
        (str(code), [str(code)]),
        (str(tmp_path), ["--find-links", str(tmp_path), finding.PACKAGE]),
    ):
        venv, pip = finding.install_commands("python3.11", own, source)
        assert venv == ["python3.11", "-m", "venv", "--clear", str(own)]
        assert pip == [str(finding.python_of(own)), "-m", "pip", "install", "--upgrade", *last]
    with pytest.raises(BakeError, match="no source is named; give a wheel"):
        finding.install_commands("python3.11", own, "")
    with pytest.raises(BakeError, match="gone.whl: no such wheel or folder"):
        finding.install_commands("python3.11", own, str(tmp_path / "gone.whl"))


def test_a_run_is_known_by_its_words_and_the_content_of_its_files(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("one")
    key = state.run_key(tmp_path, ["rollout", "fps=24"], ["a"])
    assert key == state.run_key(tmp_path, ["rollout", "fps=24"], ["a"])
    assert key != state.run_key(tmp_path, ["rollout", "fps=25"], ["a"])
    (tmp_path / "a").write_text("two")
    assert key != state.run_key(tmp_path, ["rollout", "fps=24"], ["a"])


def test_what_a_bake_keeps_survives_a_broken_file(tmp_path: Path) -> None:
    assert state.read_state(tmp_path) == {}
    state.write_state(tmp_path, capture="x")
    state.write_state(tmp_path, run="y")
    assert state.read_state(tmp_path) == {"capture": "x", "run": "y"}
    (tmp_path / "bake.json").write_text(json.dumps([1])[:2])
    assert state.read_state(tmp_path) == {}
