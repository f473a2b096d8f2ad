"""A package from outside adds an energy and a fabric; nothing that is not registered is ever built."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import hood
from hood import plugins
from hood.app.settings.compose import ConfigError, build, options
from hood.app.settings.rollout_settings import RolloutSettings
from hood.cli.main import main

WIND = '''
import os

class Wind:
    """A steady wind along x [N/kg]."""

    def __init__(self, strength: float = 2.0) -> None:
        self.strength = strength

    def applies(self, problem) -> bool:
        return self.strength != 0

    def __call__(self, problem, next_pos, acc):
        return problem.sum_vertices(-problem.cloth.mass * self.strength * next_pos[:, 0])
'''
WINDY = """
defaults:
  - default
  - _self_
terms:
  wind:
    _target_: windy_cloth.Wind
    strength: 2.0
"""
FELT = "_target_: hood.assets.material.Material\ndensity: 0.7\n"


def install(folder: Path, name: str, registered: bool) -> None:
    """A package as pip would leave it."""
    for group, option, text in (("losses", "windy", WINDY), ("material", "felt", FELT)):
        path = folder / name / "configs" / group / f"{option}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    (folder / name / "__init__.py").write_text(WIND, encoding="utf-8")
    record = folder / f"{name}-1.0.dist-info"
    record.mkdir()
    (record / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", encoding="utf-8")
    if registered:
        (record / "entry_points.txt").write_text(f"[hood.plugins]\nmine = {name}\n", encoding="utf-8")


def forget() -> None:
    plugins.forget()
    for name in ("windy_cloth", "windy_cloth_too"):
        sys.modules.pop(name, None)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty folder of packages that Python looks into; its name has a quote, a comma and a blank."""
    folder = tmp_path / "site, Anna's"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.chdir(tmp_path)
    forget()
    yield folder
    forget()


def test_an_energy_from_outside_moves_the_cloth(place: Path) -> None:
    install(place, "windy_cloth", registered=True)
    keys = {"num_frames": 4, "stepper": "newton"}
    still, blown, harder = (
        [frame.world_pos.numpy().mean(axis=0) for frame in hood.simulate("tank", "walk_proud", **keys, **more)][-1]
        for more in ({}, {"losses": "windy"}, {"losses": "windy", "losses.terms.wind.strength": 8.0})
    )
    assert 1e-3 < blown[0] - still[0] < harder[0] - still[0]


def test_its_energy_is_in_the_file_and_its_options_in_the_help(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    install(place, "windy_cloth", registered=True)
    assert main(["rollout", "--help"]) == 0
    told = capsys.readouterr().out
    assert "windy" in told
    assert "felt" in told
    hood.rollout(garment="tank", stepper="newton", losses="windy", num_frames=2, video="none", sheet=False, output="out")
    assert np.isfinite(hood.read_rollout("out/rollout.h5").metrics["energy_wind"][1])


def test_a_fabric_from_outside_is_an_option(place: Path) -> None:
    install(place, "windy_cloth", registered=True)
    assert build(RolloutSettings.from_words(["material=felt"]).material).density == 0.7
    with pytest.raises(ConfigError, match="did you mean 'felt'"):
        RolloutSettings.from_words(["material=fellt"])


def test_a_package_that_is_not_registered_is_not_built(place: Path) -> None:
    install(place, "windy_cloth", registered=False)
    assert "windy" not in options("losses")
    with pytest.raises(ConfigError, match="not allowed"):
        build({"_target_": "windy_cloth.Wind"})


@pytest.mark.parametrize("target", ["windy_cloth.os.system", "os.system", "windy_cloth_too.Wind", "builtins.eval"])
def test_a_registered_package_lets_nothing_else_in(target: str, place: Path) -> None:
    install(place, "windy_cloth", registered=True)
    install(place, "windy_cloth_too", registered=False)
    with pytest.raises(ConfigError, match="not allowed"):
        build({"_target_": target})


def test_a_registered_package_that_is_gone_is_told(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    install(place, "windy_cloth", registered=True)
    (place / "windy_cloth").rename(place / "elsewhere")
    assert main(["rollout"]) == 2
    said = capsys.readouterr().err
    assert "plugin 'windy_cloth'" in said
    assert "install it again" in said
