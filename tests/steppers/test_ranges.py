"""What weights were trained for: written down by training, read back, and compared with what a scene asks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hood.assets.files.library import locate
from hood.assets.garment.garment import Garment
from hood.assets.material import RANGES, Material
from hood.cloth.cloth import build_cloth
from hood.energies.potential import default_potential, reference_potential
from hood.scene.scene import Scene
from hood.steppers.checkpoint import load_simulator
from hood.steppers.ranges import Conditions, describe_conditions, different, outside, scene_conditions, training_conditions
from hood.testing import grid
from hood.training.scenes import SceneSampler

TRAINED = Conditions(
    {
        "gravity": (9.81, 9.81),
        "fps": (24.0, 30.0), "size": (0.9, 1.1), "betas": (-2.0, 2.0), "vertices": (900.0, 1100.0), "edge_length": (0.02, 0.04),
        "material.thickness": (4e-4, 5e-4), **{f"material.{name}": span for name, span in RANGES.items()},
    },
    default_potential().settings,
)  # fmt: skip
#: How the quantities are called in a sentence, where not by their key.
TITLES = {"vertices": "garment vertices", "edge_length": "garment mean edge", "size": "garment size"}


def asked(**spans: tuple[float, float]) -> Conditions:
    """The middle of every range but for ``spans``."""
    middle = {name: (0.5 * (low + high),) * 2 for name, (low, high) in TRAINED.spans.items()}
    return Conditions({**middle, **spans}, TRAINED.potential)


@pytest.mark.parametrize("name", TRAINED.spans)
def test_just_inside_and_just_outside_of_every_range(name: str) -> None:
    low, high = TRAINED.spans[name]
    edge = 1e-3 * (high - low)
    for inside in ((low, high), (low, low), (high, high), (low + edge, high - edge)):
        assert outside(TRAINED, asked(**{name: inside})) == []
    for beyond in ((low - edge - 2e-4 * abs(low), high), (low, high + edge + 2e-4 * abs(high))):
        (sentence,) = outside(TRAINED, asked(**{name: beyond}))
        assert sentence.startswith(f"{TITLES.get(name, name)}=")
        assert "(trained on " in sentence


def test_a_sentence_names_value_and_range() -> None:
    assert outside(TRAINED, asked(fps=(60.0, 60.0))) == ["fps=60 (trained on 24 to 30)"]
    assert outside(TRAINED, asked(betas=(-0.5, 3.0))) == ["betas=3 (trained on -2 to 2)"]
    coarse = outside(TRAINED, asked(vertices=(4423.0, 4423.0), edge_length=(0.01675, 0.01675)))
    assert sorted(coarse) == [
        "garment mean edge=16.8 mm (trained on 20 to 40 mm)",
        "garment vertices=4,423 (trained on 900 to 1,100)",
    ]


def test_a_scene_that_has_no_such_value_is_not_outside() -> None:
    scene = asked()
    spans = {name: span for name, span in scene.spans.items() if name != "betas"}
    assert outside(TRAINED, replace(scene, spans=spans)) == []


def test_files_that_name_an_energy_by_the_path_of_its_class_are_read() -> None:
    text = Conditions({}, default_potential().settings).to_json()
    older = text.replace('"term": "Collision"', '"term": "hood.losses.collision.Collision"')
    assert older != text
    assert Conditions.from_json(older) == Conditions.from_json(text)
    assert Conditions.from_json('{"spans": {}, "potential": {"mine": {"weight": 1.0}}}').potential == {"mine": {"weight": 1.0}}


def test_files_from_before_a_setting_were_trained_with_what_it_is_by_default() -> None:
    text = Conditions({}, default_potential().settings).to_json()
    older = Conditions.from_json(text.replace(', "contact": "vertices"', ""))
    assert older == Conditions.from_json(text)
    assert different(older.potential, default_potential(contact="edges").settings) == [
        "losses.terms.collision.contact=edges (trained on vertices)",
        "losses.terms.friction.contact=edges (trained on vertices)",
    ]


def test_settings_of_the_potential_are_compared_one_by_one() -> None:
    known = default_potential().settings
    assert different(known, default_potential(friction_coefficient=10.0).settings) == [
        "losses.terms.friction.coefficient=10 (trained on 0.5)"
    ]
    heavy = different(known, default_potential(collision_weight=1e6).settings, "default")
    assert heavy == [
        "losses.terms.collision.weight=1e+06 (default 500000)",
        "losses.terms.friction.weight=1e+06 (default 500000)",
    ]
    classes = different(known, reference_potential().settings)
    assert classes[0] == "losses.terms.bending=CurrentLengthBending (trained on Bending)"
    assert len(classes) == 3
    fewer = {name: term for name, term in known.items() if name != "friction"}
    assert different(known, fewer) == ["losses.terms.friction=none (trained on Friction)"]
    assert different(fewer, known) == ["losses.terms.friction=Friction (trained on none)"]


def test_text_is_read_back_exactly() -> None:
    assert Conditions.from_json(TRAINED.to_json()) == TRAINED


@pytest.mark.parametrize(
    "text",
    ["", "[]", '{"spans": {}}', '{"spans": {"fps": [30]}, "potential": {}}', '{"spans": {"fps": [31, 30]}, "potential": {}}',
     '{"spans": {"fps": [NaN, 30]}, "potential": {}}', '{"spans": {"fps": [30, Infinity]}, "potential": {}}'],
)  # fmt: skip
def test_other_texts_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="training range"):
        Conditions.from_json(text)


def test_files_that_do_not_tell_of_gravity_know_that_of_the_earth() -> None:
    old = Conditions.from_json('{"spans": {"fps": [30, 30]}, "potential": {}}')
    (sentence,) = outside(old, Conditions({"fps": (30.0, 30.0), "gravity": (98.1, 98.1)}, {}))
    assert sentence == "gravity=98.1 (trained on 9.81)"


def test_what_a_cloth_asks() -> None:
    pos, faces = grid(4, 4, 0.3)
    pieces = np.concatenate([pos, pos + [1.0, 0.0, 0.0]]), np.concatenate([faces, faces + len(pos)])
    density = np.linspace(0.1, 0.3, 2 * len(pos))
    garment = Garment("pieces", *pieces, np.zeros(len(density), dtype=bool))
    cloth = build_cloth(*pieces, Material(density=density, lame_mu=2e4))
    spans = scene_conditions(garment, cloth, 1 / 30, default_potential(), np.array([1.0, -3.0, 0.0])).spans
    assert spans["fps"] == (pytest.approx(30.0),) * 2
    assert spans["vertices"] == (len(pos), len(pos))  # of one piece: two garments of a size are no finer ones
    assert spans["betas"] == (-3.0, 1.0)
    assert spans["material.lame_mu"] == (2e4, 2e4)
    assert 0.1 < spans["material.density"][0] < spans["material.density"][1] < 0.3
    lengths = np.linalg.norm(np.diff(pieces[0][cloth.edges.numpy()], axis=1), axis=2)
    assert spans["edge_length"][0] == pytest.approx(lengths.mean(), rel=1e-6)


def test_every_scene_of_a_training_is_inside_of_it(tank_scene: Scene, skirt_scene: Scene, garments: dict[str, Garment]) -> None:
    sampler = SceneSampler(
        tank_scene.motion.body, [garments["tank"], garments["skirt"]], [tank_scene.motion.sequence], size_range=(0.8, 1.05)
    )
    trained = training_conditions(sampler, default_potential())
    assert trained.spans["fps"] == (30.0, 30.0)
    assert trained.spans["vertices"] == (994.0, 1016.0)
    assert trained.spans["size"] == (0.8, 1.05)
    rng = np.random.default_rng(0)
    for _ in range(4):
        scene = sampler.sample(rng, 4).scene
        assert (
            outside(trained, scene_conditions(scene.garment, scene.cloth, scene.dt, default_potential(), scene.motion.betas))
            == []
        )
    sampler.material = Material(density=0.3)
    spans = training_conditions(sampler, default_potential()).spans
    assert spans["material.density"] == (0.3, 0.3)  # a fabric that was given is all that was seen
    assert spans["material.lame_mu"] == (23600.0, 23600.0)
    shirt = build_cloth(garments["tshirt"].rest_pos, garments["tshirt"].faces, Material())
    assert len(outside(trained, scene_conditions(garments["tshirt"], shirt, 1 / 30, default_potential()))) == 2


@pytest.mark.parametrize(
    "name", ["quickstart", "small-fine15", "small-ours", "small-fine48", "small1", "small2", "small3", "edges"]
)
def test_the_shipped_files_say_what_they_were_trained_for(name: str, garments: dict[str, Garment]) -> None:
    trained = load_simulator(locate("weights", name)).trained_for
    assert trained is not None
    for garment in garments.values():
        cloth = build_cloth(garment.rest_pos, garment.faces, Material())
        assert outside(trained, scene_conditions(garment, cloth, 1 / 30, default_potential(), np.zeros(10))) == []
    expected = {"quickstart": "11.7 to 39.6 mm", "edges": "3.57 to 39.6 mm"}.get(name, "22.2 to 39.7 mm")
    assert describe_conditions(trained)["trained on garment mean edge"] == expected


def test_unknown_ranges_are_called_so() -> None:
    assert describe_conditions(None) == {"trained on": "unknown, the file does not say"}


def test_ranges_of_fabrics_have_their_units() -> None:
    trained = Conditions({f"material.{name}": span for name, span in RANGES.items()} | {"material.friction": (1.0, 1.0)}, {})
    told = describe_conditions(trained)
    assert told["trained on material.bending_stiffness"] == "6.3708e-08 to 0.001314 J"
    assert told["trained on material.lame_mu"] == "15909 to 63636 Pa"
    assert told["trained on material.density"] == "0.0434 to 0.7 kg/m²"
    assert told["trained on material.friction"] == "1"
    assert outside(trained, Conditions({"material.bending_stiffness": (0.5, 0.5)}, {})) == [
        "material.bending_stiffness=0.5 J (trained on 6.3708e-08 to 0.001314 J)"
    ]
