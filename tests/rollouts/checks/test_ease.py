"""How a garment sits, in figures and in a word."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from hood.cloth.state import Obstacle, State
from hood.contact.contact import find_contact
from hood.energies.potential import default_potential
from hood.rollouts.frame import FALLS_OFF, FITS, IS_TIGHT, measure_ease
from hood.rollouts.loop import simulate
from hood.scene.scene import Scene
from hood.scene.sizing import resized, sizes_of
from hood.solver.newton import NewtonSettings
from hood.steppers.newton import NewtonStepper


def onto_skin(scene: Scene, state: State, skin: Obstacle) -> torch.Tensor:
    """Half of the cloth laid 3 mm off the skin."""
    contact = find_contact(state.pos, scene.cloth.vertex_scene, skin)
    near = contact.valid & (contact.dist < contact.dist[contact.valid].median())
    return torch.where(near[:, None], contact.point + 3e-3 * contact.normal, state.pos)


def test_a_shirt_fits_is_tight_or_falls_off(tank_scene: Scene) -> None:
    state = tank_scene.start(2)
    skin = tank_scene.motion.obstacle(2, state.origin[0].numpy(), static=True)
    assert skin is not None
    state = replace(state, pos=onto_skin(tank_scene, state, skin))
    worn = measure_ease(tank_scene, tank_scene.cloth, state, 2)
    assert worn is not None
    assert worn.word == FITS
    assert worn.gap[0] <= worn.gap[1] <= worn.gap[2]
    # The same places are a stretch for cloth that is made smaller.
    smaller = measure_ease(tank_scene, resized(tank_scene.cloth, (1.0,) * 3, (0.8,) * 3), state, 2)
    assert smaller is not None
    assert smaller.gap == worn.gap
    assert smaller.word == IS_TIGHT
    fallen = replace(state, pos=state.pos - torch.tensor([0.0, 0.3, 0.0]))
    below = measure_ease(tank_scene, tank_scene.cloth, fallen, 2)
    assert below is not None
    assert below.word == FALLS_OFF
    assert below.slid == pytest.approx(worn.slid + 0.3, abs=1e-4)


def test_a_garment_grows_in_a_rollout_to_the_strain_of_its_new_size(tank_scene: Scene) -> None:
    """Strain is that of the size of the frame: without it the shirt would seem to be stretched by as much as it has grown."""
    growing = replace(tank_scene, sizes=sizes_of(1.0, 1.15, 5 / 30))
    stepper = NewtonStepper(default_potential(), NewtonSettings(target_rg=1e-2))
    frames = list(simulate(stepper, growing, default_potential(), 9, metrics="strain"))
    stays = list(simulate(stepper, tank_scene, default_potential(), 9, metrics="strain"))
    assert frames[0].metrics["strain_p50"] == stays[0].metrics["strain_p50"]
    assert frames[-1].metrics["strain_p50"] < 0.06

    def length(frame) -> float:
        ends = frame.state.pos[tank_scene.cloth.edges]
        return float((ends[:, 1] - ends[:, 0]).norm(dim=1).sum())

    assert length(frames[-1]) > 1.08 * length(stays[-1])
