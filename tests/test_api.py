"""The public interface: what it promises holds, and it does what the commands do."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from reference_oracle import make_state

import hood
from hood import api
from hood.app.settings.compose import ConfigError, plain
from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.stepping.guarding import GuardStopped
from hood.assets.garment.garment import checked_garment
from hood.steppers.newton import NewtonStepper

PACKAGE = Path(hood.__file__).parent
SHORT = {"num_frames": 3, "metrics": "strain"}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = "import sys, hood; print([name for name in ('torch', 'numpy', 'hydra', 'h5py') if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PACKAGE.parent)
    assert done.stdout.strip() == "[]"


def test_every_public_name_is_there_and_told_to_type_checkers() -> None:
    stub = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    told = {(alias.asname, node.module) for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert told == set(hood._HOMES.items())
    for name in hood.__all__:
        assert getattr(hood, name) is not None
        assert name in dir(hood)
    with pytest.raises(AttributeError, match="simulat"):
        _ = hood.simulat


def test_every_public_function_says_what_it_takes_and_raises() -> None:
    for name, home in hood._HOMES.items():
        thing = getattr(importlib.import_module(home), name)
        assert inspect.getdoc(thing), name
        if inspect.isfunction(thing):
            for part in ("Args:", "Raises:", "Examples:"):
                assert part in str(inspect.getdoc(thing)), (name, part)


@pytest.mark.parametrize("name", [name for name in hood._HOMES if inspect.isfunction(getattr(hood, name))])
def test_examples_do_what_they_show(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    if name == "load_reference_checkpoint":
        torch.save({"training_module": make_state("postcvpr", 128)}, "postcvpr.pth")
    test = doctest.DocTestFinder().find(getattr(hood, name), name, globs={})[0]
    assert test.examples
    with capsys.disabled():
        failed, _ = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE).run(test)
    assert failed == 0


def test_a_simulation_gives_the_frames_of_the_command() -> None:
    frames = [frame.world_pos.numpy() for frame in hood.simulate("tank", "plie", **SHORT)]
    summary = hood.rollout(garment="tank", sequence="plie", output="out", video="none", sheet=False, **SHORT)
    stored = hood.read_rollout(Path("out/rollout.h5")).cloth_pos
    assert summary["num_frames"] == len(frames) == 3
    assert np.array_equal(np.float32(frames), np.float32(stored))


def test_a_simulation_runs_again_the_same_and_knows_its_length() -> None:
    simulation = hood.simulate("tank", "plie", **SHORT)
    first, second = ([frame.world_pos for frame in simulation] for _ in range(2))
    assert len(simulation) == len(first) == 3
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    assert len(hood.simulate("tank", "plie", num_frames=10_000)) < 10_000


def test_own_objects_stand_for_names() -> None:
    tank = hood.load_garment("tank")
    by_name = list(hood.simulate("tank", "plie", material="denim", **SHORT))[-1].world_pos
    denim = hood.Material(density=0.45, lame_mu=5e4, lame_lambda=7e4, bending_stiffness=3e-4, thickness=4.7e-4)
    by_object = list(hood.simulate(tank, "plie", material=denim, **SHORT))[-1].world_pos
    plain = list(hood.simulate(tank, "plie", **SHORT))[-1].world_pos
    assert torch.equal(by_name, by_object)
    assert not torch.equal(plain, by_object)


def test_an_own_stepper_takes_the_steps() -> None:
    class Counting(NewtonStepper):
        calls = 0

        def predict(self, *given: object, **named: object):  # type: ignore[no-untyped-def, override]
            type(self).calls += 1
            return super().predict(*given, **named)

    simulation = hood.simulate("tank", "plie", stepper=Counting(hood.default_potential()), **SHORT)
    assert len(list(simulation)) == 3
    assert Counting.calls >= 2


def test_a_strict_guard_ends_the_simulation_and_says_where() -> None:
    simulation = hood.simulate("tank", "plie", checkpoint="untrained", model="small", guard="strict", num_frames=9)
    seen = []
    with pytest.raises(GuardStopped, match="before frame"):
        seen += simulation
    assert len(seen) < 9


@pytest.mark.parametrize(
    ("keys", "error", "said"),
    [
        ({"garmnt": "dress"}, ValueError, "did you mean 'garment'"),
        ({"num_frames": 0}, ValueError, "at least 1"),
        ({"material": "denm"}, ValueError, "did you mean 'denim'"),
        ({"fps": object()}, ValueError, "fps="),
        ({"garment": "dres"}, FileNotFoundError, "dress"),
        ({"solver": {"target": 1}}, ValueError, "target_rg"),
    ],
)
def test_what_cannot_be_used_is_told_with_its_name(keys: dict, error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        hood.simulate(**keys)


def own_garment(**changed: object) -> hood.Garment:
    tank = hood.load_garment("tank")
    fields = {"rest_pos": tank.rest_pos, "faces": tank.faces, "pinned": np.zeros(len(tank.rest_pos), bool)}
    return hood.Garment("mine", **(fields | changed))  # type: ignore[arg-type]


def with_value(array: np.ndarray, place: tuple[int, ...], value: float) -> np.ndarray:
    changed = array.copy()
    changed[place] = value
    return changed


BROKEN = {
    "nan": (lambda tank: {"rest_pos": with_value(tank.rest_pos, (7, 0), np.nan)}, "vertex 7 is .*; positions must be finite"),
    "beyond": (lambda tank: {"faces": with_value(tank.faces, (3, 1), 9999)}, "face 3 .*9999.*from 0 to 1015"),
    "negative": (lambda tank: {"faces": with_value(tank.faces, (3, 1), -1)}, "face 3 .*-1.*from 0 to 1015"),
    "float": (lambda tank: {"faces": tank.faces.astype(float)}, "must be integer"),
    "no faces": (lambda tank: {"faces": []}, "mesh is empty"),
    "quads": (lambda tank: {"faces": np.zeros((5, 4), int)}, "4 corners each; split them"),
    "ragged": (lambda tank: {"faces": [[0, 1, 2], [0, 1, 2, 3]]}, "differ in length.*split polygons"),
    "none": (lambda tank: {"faces": None}, "faces is None; give"),
    "text": (lambda tank: {"rest_pos": "here"}, "type str; give an array"),
    "flat": (lambda tank: {"rest_pos": tank.rest_pos[:, :2]}, r"give \(num_vertices, 3\)"),
    "pins": (lambda tank: {"pinned": [True, False]}, "2 rows for 1016 vertices"),
    "weights": (lambda tank: {"lbs_weights": np.ones((3, 24))}, "lbs_weights has 3 rows"),
    "levels": (lambda tank: {"coarse_edges": ([[0, 5000]],)}, "coarse edge 0 of level 0"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_own_garments_are_checked_like_files(case: str) -> None:
    change, said = BROKEN[case]
    broken = own_garment(**change(hood.load_garment("tank")))
    with pytest.raises(ValueError, match=f"^garment 'mine': .*{said}"):
        hood.simulate(broken, "plie", stepper="newton", num_frames=2)
    with pytest.raises(ValueError, match=said):
        hood.build_scene(broken, hood.load_body(), hood.load_sequence("plie"))


def test_own_garments_of_lists_and_tensors_are_those_of_arrays() -> None:
    tank = own_garment()
    lists = own_garment(**{key: getattr(tank, key).tolist() for key in ("rest_pos", "faces", "pinned")})
    tensors = own_garment(**{key: torch.as_tensor(getattr(tank, key)) for key in ("rest_pos", "faces", "pinned")})
    assert all(checked_garment(garment) is garment for garment in (tank, hood.load_garment("tank"), hood.load_garment("shirt")))
    for garment in (lists, tensors):
        for key in ("rest_pos", "faces", "pinned"):
            now, want = getattr(checked_garment(garment), key), getattr(tank, key)
            assert now.dtype == want.dtype
            assert np.array_equal(now, want)


def test_arguments_of_another_kind_are_refused_in_a_sentence() -> None:
    tank, body, plie = hood.load_garment("tank"), hood.load_body(), hood.load_sequence("plie")
    cases = [
        (lambda: hood.simulate("tank", stepper=object()), "type object, which has no gravity.*Stepper"),
        (lambda: hood.rollout(sequence=plie), "sequence is given by a name .*type PoseSequence"),
        (lambda: hood.simulate("tank", np.zeros((9, 24, 3))), r"sequence is given by .*array \(9, 24, 3\)"),
        (lambda: hood.rollout(body=body), "body is given by a name .*type Body"),
        (lambda: hood.rollout(garment=[tank, tank]), "garment is given by .*list of an object of type Garment"),
        (lambda: hood.simulate([tank, 3]), r"garment\[1\] is of type int; give a name"),
        (lambda: hood.simulate("tank", sequence=np.zeros((99, 3)).tolist()), "sequence=.*…: give one text"),
        (lambda: hood.simulate("tank", pins=np.zeros(999)), "pins=.*…: give vertex numbers"),
        (lambda: hood.simulate("tank", betas=np.zeros(999)), "betas=.*: give at most 10"),
        (lambda: hood.simulate("tank", plan={}), "plan={}: give text, such as plan=auto"),
        (lambda: hood.simulate("tank", material=np.zeros(3)), "material is of type ndarray; give a name"),
        (lambda: hood.build_scene("tank", body, plie), "garment is of type str; give a hood.Garment"),
        (lambda: hood.build_scene(tank, "default", plie), "takes a hood.Body, .* not str"),
        (lambda: hood.build_scene(tank, body, "plie"), "takes a hood.PoseSequence, .* not str"),
        (lambda: hood.build_scene(tank, body, plie, "denim"), "takes a hood.Material.* not str"),
        (lambda: hood.load_garment(tank), "garment is given by its name or file, not as Garment"),
        (lambda: hood.read_rollout("."), "a folder; give the rollout.h5 in it"),
    ]
    for call, said in cases:
        with pytest.raises(ValueError, match=said) as refused:
            call()
        assert len(str(refused.value)) < 400, said
    with pytest.raises(FileNotFoundError, match=r"^nope.h5: no such file; give the rollout.h5"):
        hood.read_rollout("nope.h5")


ODD = (
    "a/b.obj", "an 'odd' name.obj", "back\\slash", "ends\\", "\\'", "1.5", "null", "True", "[x]", "a=b", "a,b", "ä ö", "~/x",
    "${x}",
)  # fmt: skip


@pytest.mark.parametrize("text", ODD)
def test_any_text_reaches_the_config_as_it_is(text: str) -> None:
    try:
        words = api.overrides({"output": text})
        config = RolloutSettings.from_words(words)
    except ConfigError:
        assert "${" in text  # an interpolation is no text
        return
    assert str(config.output) == text


def test_values_and_groups_reach_the_config() -> None:
    words = api.overrides(
        {"betas": [1.5, -1], "body": None, "sheet": True, "solver": {"target_rg": 1e-3}, "output": Path("a/b")}
    )
    assert words == ["betas=[1.5,-1]", "body=null", "sheet=true", "solver.target_rg=0.001", "output=a/b"]
    with pytest.raises(ConfigError, match="seed"):
        api.overrides({"seed": {1, 2}})


def test_no_stepper_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match="stepper=null: cannot be left out; give one of auto, guess"):
        hood.simulate("tank", "plie", num_frames=2, stepper=None)  # type: ignore[arg-type]


def _following(count: int = 0) -> Any:
    return torch.ones(count or (), requires_grad=True)


def _of_arrays(given: Any, key: str) -> Any:
    """Something of arrays, one of them a tensor with a gradient."""
    return replace(given, **{key: torch.as_tensor(getattr(given, key)).requires_grad_()})


def _built(**keys: Any) -> Any:
    usual = {"garment": hood.load_garment("tank"), "body": hood.load_body(), "sequence": hood.load_sequence("plie")}
    return hood.build_scene(**usual | keys)


#: Where a tensor could be given, and what names it in the sentence that refuses it.
GIVEN: list[tuple[str, Callable[[], Any]]] = [
    ("material.lame_mu", lambda: hood.simulate("tank", material={"lame_mu": _following()})),
    ("material", lambda: hood.simulate("tank", material=hood.Material(lame_mu=_following(1016)))),
    ("material", lambda: hood.Material(lame_mu=hood.FaceField(_following(8)))),
    ("material", lambda: hood.Material(bending_stiffness=hood.EdgeField(_following(8)))),
    ("wind", lambda: hood.simulate("tank", wind=[_following(), 0.0, 0.0])),
    ("gravity", lambda: hood.simulate("tank", gravity=_following())),
    ("size", lambda: hood.simulate("tank", size=_following())),
    ("size", lambda: hood.simulate("tank", size={"sleeves": _following()})),
    ("betas", lambda: hood.simulate("tank", betas=_following(3))),
    ("fps", lambda: hood.simulate("tank", fps=_following())),
    ("solver.target_rg", lambda: hood.simulate("tank", solver={"target_rg": _following()})),
    (
        "losses.terms.friction.coefficient",
        lambda: hood.simulate("tank", losses={"terms": {"friction": {"coefficient": _following()}}}),
    ),
    (
        "stepper: friction.coefficient",
        lambda: hood.simulate("tank", stepper=NewtonStepper(hood.default_potential(friction_coefficient=_following()))),
    ),
    ("garment 'tank': rest_pos", lambda: hood.simulate(_of_arrays(hood.load_garment("tank"), "rest_pos"))),
    ("garment 'tank': rest_pos", lambda: hood.simulate([_of_arrays(hood.load_garment("tank"), "rest_pos")])),
    ("body 'default': v_template", lambda: hood.simulate("tank", body=_of_arrays(hood.load_body(), "v_template"))),
    ("sequence: poses", lambda: hood.simulate("tank", _of_arrays(hood.load_sequence("plie"), "poses"))),
    ("body: vertices", lambda: hood.BodyMesh(torch.ones(3, 4, 3, requires_grad=True), np.array([[0, 1, 2]]))),  # type: ignore[arg-type]
    ("size", lambda: _built(size=_following())),
    ("size", lambda: _built(size=[_following(), 1.0, 1.0])),
    ("betas", lambda: _built(betas=_following(10))),
    ("garment 'tank': rest_pos", lambda: _built(garment=_of_arrays(hood.load_garment("tank"), "rest_pos"))),
    ("material.density", lambda: hood.rollout(garment="tank", material={"density": _following()})),
    ("material.density", lambda: hood.dress(garments=["tank"], material={"density": _following()})),
    ("size", lambda: hood.fit(garment="tank", size=_following())),
    ("trainer.learning_rate", lambda: hood.train(trainer={"learning_rate": _following()})),
    ("fps", lambda: hood.export("none", fps=_following())),
]


@pytest.mark.parametrize(("key", "call"), GIVEN, ids=[f"{number}-{key}" for number, (key, _) in enumerate(GIVEN)])
def test_tensors_with_a_gradient_are_refused_where_it_would_be_dropped(key: str, call: Callable[[], Any]) -> None:
    with pytest.raises(ValueError, match=f"^{key}: its tensor requires a gradient, .* hood.differentiable does; give") as told:
        call()
    assert "\n" not in str(told.value)


def test_numbers_and_arrays_of_numpy_and_torch_are_numbers_and_lists() -> None:
    given = {"num_frames": np.int64(3), "gravity": np.float32(9.5), "betas": np.array([1.0, 0.5]), "pins": torch.tensor([1, 4])}
    assert api.overrides(given) == ["num_frames=3", "gravity=9.5", "betas=[1.0,0.5]", "pins=[1,4]"]


def test_tables_reach_the_config() -> None:
    words = api.overrides({"size": {"sleeves": 1.2}, "fabrics": {"above_waistband": {"material": "silk", "friction": 2}}})
    assert words == ["size={sleeves:1.2}", "fabrics={above_waistband:{material:silk,friction:2}}"]
    events = [{"time": 0.5, "open": "front_buttons"}]
    config = RolloutSettings.from_words([*words, *api.overrides({"events": events})])
    assert plain(config.size) == {"sleeves": 1.2}
    assert plain(config.fabrics) == {"above_waistband": {"material": "silk", "friction": 2}}
    assert plain(config.events) == events
    with pytest.raises(ConfigError, match="fabrics: 'a part' cannot be a key of a table"):
        api.overrides({"fabrics": {"a part": "silk"}})


def test_a_simulation_takes_tables_and_events() -> None:
    shirt = hood.simulate(
        "shirt", num_frames=1, stepper="guess", size={"sleeves": 1.1}, fabrics={"sleeves": "silk"},
        events=[{"time": 0.0, "open": "front_buttons"}],
    )  # fmt: skip
    plain_shirt = hood.simulate("shirt", num_frames=1, stepper="guess")
    longer = shirt.scene.cloth.rest_area.sum() / plain_shirt.scene.cloth.rest_area.sum()
    assert 1.02 < float(longer) < 1.21
    assert len(shirt.scene.cloth.lame_mu.unique()) == 2
