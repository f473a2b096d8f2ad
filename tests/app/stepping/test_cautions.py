"""Values that a network was not trained for, and potentials that it does not look at, are named in one line."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from hood.app import setup
from hood.app.common import weigh
from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.setup import make_stepper
from hood.app.stepping.cautions import evaluation_cautions, known_by_slope, scene_cautions
from hood.app.stepping.steppers import losses_of
from hood.assets.body.body import Body
from hood.assets.files.library import locate
from hood.assets.garment.garment import load_garment
from hood.assets.material import Material
from hood.assets.motion.sequence import PoseSequence
from hood.cli.main import main
from hood.energies.contact import Collision
from hood.energies.potential import coded_potential, default_potential
from hood.energies.self_contact import LayerBarrier, LayerFriction, SignedSelfContactPenalty
from hood.scene.scene import Scene, build_scene
from hood.solver.newton import NewtonSettings
from hood.steppers.checkpoint import load_simulator, save_simulator
from hood.steppers.network import NetworkStepper, build_simulator
from hood.steppers.newton import NewtonStepper
from hood.steppers.ranges import Conditions, scene_conditions
from hood.steppers.refined import GuessStepper, RefinedStepper
from hood.steppers.stopping import Count

DEFAULT, ROUGH = default_potential(), default_potential(friction_coefficient=10.0)


@pytest.fixture(scope="module")
def quickstart() -> NetworkStepper:
    return load_simulator(locate("weights", "quickstart"))


@pytest.fixture(scope="module")
def paper() -> NetworkStepper:
    torch.manual_seed(0)
    return build_simulator("paper", "acceleration", "1x(mesh)", latent_dim=8).eval()


def refined(stepper: NetworkStepper) -> RefinedStepper:
    return RefinedStepper(stepper, DEFAULT, Count(1), "newton", NewtonSettings())


def test_nothing_is_said_of_what_was_trained(quickstart: NetworkStepper, tank_scene: Scene) -> None:
    assert scene_cautions(quickstart, tank_scene, DEFAULT, "quickstart") == []


class OwnCollision(Collision):
    """Contact that somebody has written."""


def test_terms_that_the_solver_knows_by_their_slope_are_named_where_it_works(quickstart: NetworkStepper) -> None:
    own = DEFAULT.with_terms(collision=OwnCollision())
    (sentence,) = known_by_slope(refined(quickstart), own)
    assert "\n" not in sentence
    assert sentence.startswith("losses.terms.collision (test_cautions.OwnCollision): the solver knows the slope alone")
    assert "take many iterations" in sentence
    assert known_by_slope(NewtonStepper(own, NewtonSettings()), own) == [sentence]
    assert known_by_slope(quickstart, own) == []
    layered = DEFAULT.with_terms(layers=LayerBarrier(), layer_friction=LayerFriction(), sides=SignedSelfContactPenalty())
    for potential in (DEFAULT, coded_potential(), layered, losses_of(RolloutSettings.from_words([]))):
        assert known_by_slope(refined(quickstart), potential) == []


def test_a_rollout_says_so_when_it_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before any step is taken."""
    own, said = DEFAULT.with_terms(collision=OwnCollision()), list[str]()
    monkeypatch.setattr(setup, "losses_of", lambda config: own)
    config = RolloutSettings.from_words(["stepper=newton", "garment=tank", "sequence=walk_proud", "num_frames=2"])
    setup.set_up(config, make_stepper(config)[0], tell=said.append)
    assert sum("the solver knows the slope alone" in sentence for sentence in said) == 1


def vertices(simulator: NetworkStepper) -> str:
    """Of the garments that it was trained on, as it is told."""
    assert simulator.trained_for is not None
    return " to ".join(f"{value:,.0f}" for value in simulator.trained_for.spans["vertices"])


def test_garments_of_1k_and_4k_were_trained(quickstart: NetworkStepper, body: Body, walk: PoseSequence) -> None:
    scene = build_scene(load_garment("dress_4k"), body, walk.window(0, 4))
    assert scene_cautions(quickstart, scene, DEFAULT, "quickstart") == []


def test_finer_garments_are_named_with_the_way_out(quickstart: NetworkStepper, body: Body, walk: PoseSequence) -> None:
    scene = build_scene(load_garment("dress_12k"), body, walk.window(0, 4))
    (sentence,) = scene_cautions(quickstart, scene, DEFAULT, "quickstart")
    assert sentence.startswith(
        f"quickstart was not trained for garment vertices=11,988 (trained on {vertices(quickstart)}), garment mean "
    )
    assert "stepper=newton" in sentence
    assert "refine=10" in sentence
    (sentence,) = scene_cautions(refined(quickstart), scene, DEFAULT, "quickstart")
    assert "refine=" not in sentence
    assert scene_cautions(GuessStepper(DEFAULT), scene, DEFAULT, "") == []


def test_the_potential_of_a_network_that_looks_at_it(quickstart: NetworkStepper, tank_scene: Scene) -> None:
    (sentence,) = scene_cautions(quickstart, tank_scene, ROUGH, "quickstart")
    assert sentence.startswith(
        "quickstart was not trained for losses.terms.friction.coefficient=10 (trained on 0.5); the motion may be wrong"
    )


def test_the_potential_of_a_network_that_does_not(paper: NetworkStepper, tank_scene: Scene) -> None:
    assert scene_cautions(paper, tank_scene, DEFAULT, "old.pth") == []
    (sentence,) = scene_cautions(paper, tank_scene, ROUGH, "old.pth")
    assert sentence.startswith(
        "losses.terms.friction.coefficient=10 (default 0.5) changes only what is measured, not the motion: old.pth does not"
    )
    (sentence,) = scene_cautions(refined(paper), tank_scene, ROUGH, "old.pth")
    assert "changes only what is measured and how steps are refined, not what is predicted" in sentence
    assert sentence.endswith("old.pth does not look at the potential; moved by it: stepper=newton")


def test_such_a_networks_own_potential_is_the_one_it_was_trained_with(paper: NetworkStepper, tank_scene: Scene) -> None:
    trained = paper.clone().eval()
    trained.trained_for = scene_conditions(tank_scene.garment, tank_scene.cloth, tank_scene.dt, ROUGH)
    assert scene_cautions(trained, tank_scene, ROUGH, "mine") == []
    (sentence,) = scene_cautions(trained, tank_scene, DEFAULT, "mine")
    assert sentence.startswith("losses.terms.friction.coefficient=0.5 (trained on 10) changes only what is measured")


def test_what_the_weights_say_of_themselves_is_told_where_they_are_used(
    tmp_path: Path, paper: NetworkStepper, tank_scene: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    save_simulator(tmp_path / "weak.safetensors", paper)
    given = [f"checkpoint={tmp_path}/weak.safetensors", f"output={tmp_path}/told.safetensors"]
    assert main(["convert", *given, "caution=no rollout is useful yet"]) == 0
    weak = load_simulator(tmp_path / "told.safetensors")
    assert scene_cautions(refined(weak), tank_scene, DEFAULT, "weak")[0] == "weak: no rollout is useful yet"
    tank = scene_conditions(tank_scene.garment, tank_scene.cloth, 1 / 30, DEFAULT)
    told = evaluation_cautions({"weak": weak, "copy": weak.clone(), "old": paper}, {"tank": tank})
    assert told == ["weak, copy: no rollout is useful yet"]
    capsys.readouterr()
    assert main(["inspect", f"{tmp_path}/told.safetensors"]) == 0
    assert "  caution: no rollout is useful yet" in capsys.readouterr().out


def test_an_evaluation_says_it_once(quickstart: NetworkStepper, paper: NetworkStepper, tank_scene: Scene) -> None:
    tank = scene_conditions(tank_scene.garment, tank_scene.cloth, 1 / 60, DEFAULT)
    fine = Conditions({**tank.spans, "vertices": (9e3, 9e3)}, tank.potential)
    steppers = {"quickstart": quickstart, "copy": quickstart.clone(), "old": paper, "guess": GuessStepper(DEFAULT)}
    (sentence,) = evaluation_cautions(steppers, {"tank": tank, "tank_9k": fine})
    assert sentence.startswith(
        "quickstart, copy: not trained for fps=60 (trained on 30); "
        f"garment vertices=9,000 (trained on {vertices(quickstart)}) of tank_9k;"
    )
    assert "stepper=newton" in sentence
    rough = replace(tank, potential=ROUGH.settings)
    assert [text.split(":")[0] for text in evaluation_cautions(steppers, {"tank": rough})] == ["quickstart, copy", "old"]


def test_a_rollout_warns_once_and_writes_it_down(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    paper: NetworkStepper,
    tank_scene: Scene,
) -> None:
    known = paper.clone().eval()
    known.trained_for = scene_conditions(tank_scene.garment, tank_scene.cloth, 1 / 30, DEFAULT)
    save_simulator(tmp_path / "paper.safetensors", known)
    quick = ["num_frames=2", "video=none", "sheet=false", "metrics=none", "fail_on=nothing", "garment=tank"]
    quick += ["guard=off", f"checkpoint={tmp_path}/paper.safetensors"]
    (tmp_path / "list.txt").write_text("walk_proud\nplie\n")
    monkeypatch.chdir(tmp_path)
    for extra, expected in (([], []), (["fps=60", "sequence=list.txt"], ["fps=60 (trained on 30)"])):
        out = tmp_path / ("many" if extra else "one")
        assert main(["rollout", *quick, *extra, f"output={out}"]) == 0
        lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("hood: warning: ")]
        assert [re.findall(r"for (fps=\d+ \(trained on \d+\))", line)[0] for line in lines] == expected
        folders = [out / "walk_proud", out / "plie"] if extra else [out]
        for folder in folders:
            warned = json.loads((folder / "summary.json").read_text())["warnings"]
            assert [f"hood: warning: {text}" for text in warned] == lines


def test_an_evaluation_warns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["models=[small-fine15]", "garments=[tank]", "num_frames=4", "gap_states=0", "fps=25", f"output={tmp_path}"]
    assert main(["evaluate", *arguments]) == 0
    assert "hood: warning: small-fine15: not trained for fps=25 (trained on 30);" in capsys.readouterr().err


def test_inspect_prints_the_ranges(tmp_path: Path, quickstart: NetworkStepper, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(locate("weights", "quickstart"))]) == 0
    shown = capsys.readouterr().out
    known = f"garment vertices: {vertices(quickstart)}"
    for line in ("fps: 30", "betas: -2 to 2", known, "material.lame_mu: 15909 to 63636 Pa"):
        assert f"  trained on {line}\n" in shown
    torch.manual_seed(0)
    save_simulator(tmp_path / "old.safetensors", build_simulator("paper", "acceleration", "1x(mesh)", latent_dim=8))
    assert main(["inspect", str(tmp_path / "old.safetensors")]) == 0
    assert "trained on: unknown" in capsys.readouterr().out


def test_a_gravity_that_nobody_was_trained_for(quickstart: NetworkStepper, tank_scene: Scene) -> None:
    heavy = quickstart.clone().eval()
    weigh(heavy, RolloutSettings.from_words(["gravity=98.1"]))
    (sentence,) = scene_cautions(heavy, tank_scene, DEFAULT, "quickstart")
    assert sentence.startswith("quickstart was not trained for gravity=98.1 (trained on 9.81)")
    assert scene_cautions(quickstart, tank_scene, DEFAULT, "quickstart") == []


@pytest.mark.parametrize("kind", ["stepper=newton", "stepper=refine", "checkpoint=small1"])
def test_gravity_acts_in_every_stepper(kind: str) -> None:
    stepper, _ = make_stepper(RolloutSettings.from_words([kind, "gravity=1.62", "kernels=torch"]))
    assert stepper.gravity.tolist() == pytest.approx([0.0, -1.62, 0.0])


@pytest.mark.parametrize("value", ["-1", ".inf", "2000"])
def test_a_gravity_that_is_none_is_refused(value: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rollout", f"gravity={value}"]) == 2
    assert "gravity" in capsys.readouterr().err


def test_a_network_says_that_it_knows_no_warp_and_weft(quickstart: NetworkStepper, body: Body, walk: PoseSequence) -> None:
    woven = build_scene(load_garment("tank"), body, walk.window(0, 4), Material(warp=50.0, weft=20.0, shear=0.5))
    for stepper, ways in ((quickstart, "refine=10 corrects every step"), (refined(quickstart), "needs no weights")):
        (sentence,) = scene_cautions(stepper, woven, DEFAULT, "quickstart")
        for key, value in (("warp", "50"), ("weft", "20"), ("shear", "0.5")):
            assert f"material.{key}={value} (trained on 1)" in sentence
        assert sentence.endswith(ways)
    solver, _ = make_stepper(RolloutSettings.from_words(["stepper=newton"]))
    assert scene_cautions(solver, woven, DEFAULT, "newton") == []
