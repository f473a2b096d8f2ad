"""Starts in poses that a garment cannot be put on in: the body moves into them from the T-pose, unseen."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from imitations import write_seated

from hood.assets.body.body import Body
from hood.assets.files.library import locate
from hood.assets.garment.garment import Garment, load_garment
from hood.assets.motion.load import load_sequence
from hood.assets.motion.sequence_edit import blend_in
from hood.cloth.state import State
from hood.energies.potential import default_potential
from hood.energies.self_contact import LayerBarrier
from hood.rollouts.equilibrium import Rest
from hood.rollouts.loop import rest_state, simulate
from hood.scene.scene import LEAD_IN, NotWornError, Scene, build_scene
from hood.steppers.checkpoint import load_simulator
from hood.steppers.network import Prediction
from hood.steppers.refined import GuessStepper, RefinedStepper
from hood.steppers.stopping import Count

POTENTIAL = default_potential()


def stepper() -> RefinedStepper:
    """No network: three iterations a frame."""
    return RefinedStepper(GuessStepper(POTENTIAL), POTENTIAL, Count(3))


def test_the_way_from_the_t_pose_is_that_of_blend_in(tmp_path: Path, garments: dict[str, Garment], body: Body) -> None:
    """It ends in the frame that is asked for."""
    sequence = load_sequence(write_seated(tmp_path / "seated.npz"))
    scene, shown = (build_scene(garments["tank"], body, motion) for motion in (sequence, blend_in(sequence, LEAD_IN)))
    lead = scene.lead_in(0)
    assert lead is not None
    assert lead.num_frames == round(LEAD_IN * sequence.fps) + 1
    for frame, of, other in ((lead.num_frames - 1, scene, 0), (3, shown, 3)):
        where = scene.motion.translation[0]
        np.testing.assert_allclose(lead.motion.surface(frame, where), of.motion.surface(other, where), atol=1e-6)
    states = [each.start(0, relaxed=False, thorough=True) for each in (lead, shown)]
    pos = [state.pos.double().numpy() + state.origin[0].numpy() for state in states]
    np.testing.assert_allclose(pos[0], pos[1], atol=1e-6)


def test_the_garment_is_put_on_in_the_t_pose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, garments: dict[str, Garment], body: Body
) -> None:
    """Frame 0 is the motion's first; the cloth starts as the way there, shortened here, leaves it."""
    monkeypatch.setattr("hood.scene.scene._TORN", 0.1)  # in 60 iterations this dress is stretched by more
    monkeypatch.setattr("hood.scene.start._MOST_ITERATIONS", 60)
    monkeypatch.setattr("hood.scene.scene.LEAD_IN", 0.4)
    scene = build_scene(garments["dress"], body, load_sequence(write_seated(tmp_path / "seated.npz")))
    with pytest.raises(NotWornError, match="passes through 'seated' in frame 0"):
        scene.start(0, relaxed=False, thorough=True)
    with pytest.warns(UserWarning, match="moves into it from the T-pose"):
        frames = list(simulate(stepper(), scene, POTENTIAL, 2, metrics="none"))
    assert [frame.index for frame in frames] == [0, 1]
    for frame in frames:
        np.testing.assert_allclose(frame.body_pos, scene.motion.surface(frame.index, np.zeros(3)).double(), atol=1e-5)
    lead = scene.lead_in(0)
    assert lead is not None
    *_, last = simulate(stepper(), lead, POTENTIAL, metrics="none")
    assert last.index == 12
    np.testing.assert_array_equal(frames[0].world_pos, last.world_pos)


def test_a_start_with_long_edges_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, garments: dict[str, Garment], body: Body
) -> None:
    monkeypatch.setattr("hood.scene.scene._TORN", 10.0)
    monkeypatch.setattr("hood.scene.start._MOST_ITERATIONS", 60)
    scene = build_scene(garments["tshirt"], body, load_sequence(write_seated(tmp_path / "seated.npz")))
    told = r"'tshirt' starts with edges stretched by up to \d+% in frame 0 of 'seated': .* standing pose \(blend_in=1\)"
    with pytest.warns(UserWarning, match=told):
        next(simulate(stepper(), scene, POTENTIAL, 2, metrics="none"))


@pytest.mark.parametrize(
    ("pieces", "why"),
    [
        (2, r"its garments were taken apart, \d+% before: .*layers="),
        (1, r"it was smoothed where it passes through itself, .*betas="),
    ],
)
def test_edges_stretched_by_taking_cloth_apart_are_not_put_down_to_the_pose(
    monkeypatch: pytest.MonkeyPatch, tank_scene: Scene, pieces: int, why: str
) -> None:
    """Garments are taken apart from each other, a single one from itself."""

    def pulled(scene: Scene, state: State, frame: int) -> State:
        return State(state.pos * torch.tensor([1.0, 1.6, 1.0]), state.vel, state.origin)

    monkeypatch.setattr("hood.rollouts.loop._taken_apart", pulled)
    potential = default_potential().with_terms(layers=LayerBarrier())
    piece = np.arange(tank_scene.cloth.num_vertices) % pieces
    scene = replace(tank_scene, garment=replace(tank_scene.garment, piece=piece))
    taken = RefinedStepper(GuessStepper(potential), potential, Count(1))
    with pytest.warns(UserWarning, match=rf"stretched by up to \d+% since {why}"):
        next(simulate(taken, scene, potential, 2, metrics="none"))

    def found(scene: Scene, potential: object, start: State, *others: object) -> Rest:
        return Rest(scene.start(0).pos if pieces == 2 else start.pos, start.pos, 1, 0.0, 0.0)

    monkeypatch.setattr("hood.rollouts.loop.find_equilibrium", found)
    with warnings.catch_warnings(record=True) as heard:  # what settles is told where it is stretched at rest as well
        warnings.simplefilter("always")
        rest_state(taken, scene, potential, 2)
    assert sum("stretched by up to" in str(one.message) for one in heard) == (pieces == 1)


def test_what_the_t_pose_does_not_help_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, garments: dict[str, Garment], body: Body
) -> None:
    monkeypatch.setattr("hood.scene.scene._TORN", -1.0)  # nothing is taken for worn
    monkeypatch.setattr("hood.scene.start._MOST_ITERATIONS", 1)
    scene = build_scene(garments["tank"], body, load_sequence(write_seated(tmp_path / "seated.npz")))
    with pytest.raises(NotWornError, match="passes through 'seated' in frame 0"):
        next(simulate(stepper(), scene, POTENTIAL, 3))


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_way_that_breaks_the_cloth_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, garments: dict[str, Garment], body: Body, value: float
) -> None:
    monkeypatch.setattr("hood.scene.scene._TORN", 0.1)
    monkeypatch.setattr("hood.scene.start._MOST_ITERATIONS", 60)
    monkeypatch.setattr("hood.scene.scene.LEAD_IN", 0.1)
    scene = build_scene(garments["dress"], body, load_sequence(write_seated(tmp_path / "seated.npz")))

    class Broken(GuessStepper):
        def predict(self, *args: Any) -> Prediction:
            known = super().predict(*args)
            return replace(known, next_pos=known.next_pos + value, acc=known.acc + value)

    if np.isnan(value):
        with pytest.raises(NotWornError, match="passes through 'seated' in frame 0"):
            next(simulate(Broken(POTENTIAL), scene, POTENTIAL, 2, relaxing_steps=0, metrics="none"))
    else:
        with pytest.warns(UserWarning, match="T-pose"):
            next(simulate(Broken(POTENTIAL), scene, POTENTIAL, 2, relaxing_steps=0, metrics="none"))


@pytest.mark.slow
def test_a_fine_t_shirt_on_a_seated_body(tmp_path: Path, body: Body) -> None:
    """Settled there its edges are stretched by more than the double; it starts there all the same."""
    scene = build_scene(load_garment("tshirt_4k"), body, load_sequence(write_seated(tmp_path / "seated.npz")))
    with pytest.raises(NotWornError):
        scene.start(0, relaxed=False, thorough=True)
    with pytest.warns(UserWarning, match="moves into it from the T-pose in 1 s that are simulated and dropped"):
        frame = next(simulate(load_simulator(locate("weights", "quickstart")), scene, POTENTIAL, 2, metrics="strain"))
    assert frame.metrics["strain_p50"] < 0.04
    assert bool(frame.world_pos.isfinite().all())
