"""Frame 0 at rest: found by the solver, the same for all steppers, and said where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from garment_kinds import cape, clean, sewn_lining
from reference_oracle import make_state
from torch import Tensor

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.garment.outfit import join_garments
from hood.assets.motion.load import load_sequence
from hood.assets.motion.mesh_sequence import MeshSequence
from hood.assets.motion.sequence import PoseSequence
from hood.cloth.state import Attachments
from hood.contact.further import CUT_SHARE
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.mesh.penetration.crossing import crossings
from hood.rollouts import equilibrium
from hood.rollouts.equilibrium import Rest, find_equilibrium, without_hold
from hood.rollouts.frame import SETTLE_CHOICES, SETTLE_METRICS, Frame, metric_names
from hood.rollouts.loop import own_start, simulate
from hood.scene.body_motion.mesh_motion import NoBody, mesh_motion
from hood.scene.scene import Scene, build_scene, dressed_scene
from hood.steppers import newton as stepping
from hood.steppers.network import build_simulator
from hood.steppers.newton import NewtonStepper, Stepper
from hood.steppers.published import import_reference_weights
from hood.steppers.refined import GuessStepper
from hood.studies.envelope.extreme_garments import FAULTS
from hood.testing import cylinder, grid

POTENTIAL = default_potential()
GRAVITY = torch.tensor([0.0, -9.81, 0.0])


def still(walk: PoseSequence, num_frames: int) -> PoseSequence:
    """A body that keeps the first pose of the walk."""
    poses, transl = (np.repeat(values[:1], num_frames, axis=0) for values in (walk.poses, walk.transl))
    return replace(walk, poses=poses, transl=transl)


def settled(scene: Scene, attachments: Attachments | None = None, potential: Potential = POTENTIAL) -> Rest:
    state = scene.start(0, relaxed=False, thorough=True)
    return find_equilibrium(scene, potential, state, 0, GRAVITY, attachments)


def first_frame(stepper: Stepper, scene: Scene, settle: str = "equilibrium", **options: object) -> Frame:
    return next(simulate(stepper, scene, POTENTIAL, 2, metrics="none", settle=settle, **options))  # type: ignore[arg-type]


def drop(scene: Scene, settle: str) -> float:
    """[m] by which the cloth falls on average in half a second."""
    frames = list(simulate(NewtonStepper(POTENTIAL), scene, POTENTIAL, 16, metrics="none", settle=settle))
    return float((frames[0].world_pos - frames[-1].world_pos)[:, 1].mean())


def test_cloth_at_rest_does_not_fall(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    scene = build_scene(garments["tank"], body, still(walk, 16), dtype=torch.float64)
    assert drop(scene, "paper") > 1e-2
    assert abs(drop(scene, "equilibrium")) < 3e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tshirt", "tank", "longsleeve", "shorts", "trousers", "dress", "skirt"])
def test_no_default_garment_falls(name: str, garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    assert abs(drop(build_scene(garments[name], body, still(walk, 16), dtype=torch.float64), "equilibrium")) < 3e-3


def test_every_stepper_starts_from_the_same_state(band_scene: Scene) -> None:
    """At rest on the body of frame 0, and moving with it."""
    simulator = build_simulator("physical", "velocity_base", "1x(mesh+coarse0)", latent_dim=8).eval()
    steppers: list[Stepper] = [simulator, NewtonStepper(POTENTIAL), GuessStepper(POTENTIAL)]
    frames = [first_frame(stepper, band_scene) for stepper in steppers]
    for stepper, frame in zip(steppers, frames, strict=True):
        assert torch.equal(frame.world_pos, frames[0].world_pos)
        assert torch.equal(frame.state.vel, band_scene.start_velocity(0))
        assert set(SETTLE_METRICS) <= set(frame.metrics)
        assert set(frame.metrics) <= set(metric_names(POTENTIAL, stepper, "none", "equilibrium"))
    assert frames[0].metrics["settle_reached"] == 1.0
    assert frames[0].metrics["settle_speed"] <= 1e-3
    pinned, state = band_scene.cloth.pinned, band_scene.start(0, relaxed=False)
    torch.testing.assert_close(frames[0].state.pos[pinned], state.pos[pinned], rtol=0, atol=1e-6)


def test_an_equilibrium_stays_where_it_is(band_scene: Scene) -> None:
    """Settled again it moves by no more than it is allowed to, and on the way its forces have come into balance."""
    rest = settled(band_scene)
    start = band_scene.start(0, relaxed=False, thorough=True)
    again = find_equilibrium(band_scene, POTENTIAL, replace(start, pos=rest.pos), 0, GRAVITY)
    first, second = (float((b - a).norm(dim=1).mean()) for a, b in ((start.pos, rest.pos), (rest.pos, again.pos)))
    assert second < min(2e-3, 0.5 * first)


def test_coarse_cloth_rests_out_of_the_skin(garments: dict[str, Garment], body: Body, monkeypatch: pytest.MonkeyPatch) -> None:
    """Flat triangles of 7 cm chord error into the body: held farther off, they do not."""
    coarse = FAULTS["remesh"](garments["dress"], 300.0, np.random.default_rng(0))
    scene = build_scene(coarse, body, load_sequence("dance_mixed"), dtype=torch.float32)

    def in_the_skin() -> float:
        pos, skin = settled(scene).pos.double().numpy(), scene.step_input(0, scene.start(0), relaxing=True).obstacle
        assert skin is not None
        pairs = crossings(pos, coarse.faces, skin.next_pos.double().numpy(), skin.faces.numpy()).pairs
        return len(np.unique(pairs[:, 0])) / len(coarse.faces)

    after = in_the_skin()
    monkeypatch.setattr(stepping, "MOST_RAISED", 0)
    assert after <= CUT_SHARE < 0.02 < in_the_skin()


def test_a_frame_in_the_middle_has_its_own_body(band_scene: Scene) -> None:
    late = first_frame(NewtonStepper(POTENTIAL), band_scene, start_frame=5)
    pinned, target = band_scene.cloth.pinned, band_scene.motion.skinned(band_scene.garment, 5, late.state.origin[0].numpy())
    torch.testing.assert_close(late.state.pos[pinned], target[pinned], rtol=0, atol=1e-6)
    assert torch.equal(late.state.vel, band_scene.start_velocity(5))


def sheet(held: bool, height: float = 1.5) -> Garment:
    """Half a metre square, level, in the air; one side is held or none."""
    pos, faces = grid(6, 6, 0.5)
    return Garment("sheet", pos + np.array([0.0, height, 0.0]), faces, (pos[:, 0] < 0.01) & held)


def test_without_a_body_a_sheet_hangs_from_its_pins() -> None:
    scene = dressed_scene(sheet(held=True), NoBody(3, 30.0))
    rest = settled(scene)
    height = (rest.pos + scene.start(0).origin.to(rest.pos))[:, 1]
    assert rest.reached
    assert float(height.min()) == pytest.approx(1.0, abs=0.02)
    assert float(height[scene.cloth.pinned].min()) == pytest.approx(1.5)


def test_what_nothing_holds_is_left_as_it_is() -> None:
    """A part without pins, where there is no body, falls from its start."""
    tube = cylinder(8, 3, 0.1, 0.1)
    loose = join_garments([sheet(held=True), Garment("tube", *tube, np.zeros(len(tube[0]), dtype=bool))])
    scene = dressed_scene(loose, NoBody(3, 30.0))
    assert without_hold(scene) is not None
    with pytest.warns(UserWarning, match="is not settled, it falls from its start: "):
        frame = first_frame(NewtonStepper(POTENTIAL), scene)
    assert_as_in_the_paper(frame, scene)


@pytest.mark.parametrize("held", [True, False])
def test_a_sheet_starts_as_it_is_given(held: bool, body: Body, walk: PoseSequence) -> None:
    """It is to fall, or to swing down from its pins."""
    scene = dressed_scene(sheet(held=True), NoBody(3, 30.0)) if held else sheet_above(body, walk)
    assert own_start(NewtonStepper(POTENTIAL), scene) == "a sheet starts as it is given"
    assert_as_in_the_paper(first_frame(NewtonStepper(POTENTIAL), scene), scene)


def assert_as_in_the_paper(frame: Frame, scene: Scene) -> None:
    paper = first_frame(NewtonStepper(POTENTIAL), scene, "paper")
    assert torch.equal(frame.world_pos, paper.world_pos)
    assert frame.metrics.keys() == paper.metrics.keys()


def sheet_above(body: Body, walk: PoseSequence) -> Scene:
    """A level sheet ten centimetres above a body that is a mesh: it is to fall on it."""
    surface = body.surface(walk.window(0, 1), np.zeros(10), torch.float64).numpy()
    sequence = MeshSequence("doll", surface, body.faces, 30.0)
    return dressed_scene(sheet(held=False, height=float(surface[0, :, 1].max()) + 0.1), mesh_motion(sequence, 3))


def test_a_garment_that_slides_off_starts_as_it_is_put_on(body: Body, walk: PoseSequence) -> None:
    """A tube far wider than the body."""
    pos, faces = cylinder(24, 4, 0.6, 0.2)
    scene = build_scene(Garment("hoop", pos, faces, np.zeros(len(pos), dtype=bool)), body, still(walk, 3))
    with pytest.warns(UserWarning, match="'hoop' comes off the body when it settles"):
        rest = settled(scene)
    assert rest.lost == (0,)
    assert not rest.reached
    assert torch.equal(rest.pos, scene.start(0, relaxed=False, thorough=True).pos)


def test_a_part_that_slides_off_is_put_back_and_the_others_settle(
    body: Body, walk: PoseSequence, garments: dict[str, Garment]
) -> None:
    """Named by its number, its vertices and its place."""
    pos, faces = cylinder(24, 4, 0.6, 0.2)
    hoop = Garment("hoop", pos, faces, np.zeros(len(pos), dtype=bool))
    both = build_scene(join_garments([garments["tank"], hoop]), body, still(walk, 3))
    count = len(garments["tank"].rest_pos)
    with pytest.warns(UserWarning, match=rf"part 2 of 'hoop' \(96 vertices from {count} on, at \[.*\] m\) comes off the body"):
        rest = settled(both)
    assert rest.lost == (1,)
    start = both.start(0, relaxed=False, thorough=True).pos
    assert torch.equal(rest.pos[count:], start[count:])
    alone = settled(build_scene(garments["tank"], body, still(walk, 3)))
    torch.testing.assert_close(rest.pos[:count], alone.pos, rtol=0, atol=2e-3)
    assert not torch.equal(rest.pos[:count], start[:count])


def test_a_lining_that_closes_the_rims_makes_no_sheet_of_a_garment(body: Body, walk: PoseSequence) -> None:
    """Nor is a cape one that lies around the shoulders; a sheet that is to fall on the body is."""
    scenes = [
        build_scene(Garment("own", *mesh, np.zeros(len(mesh[0]), dtype=bool)), body, still(walk, 3))
        for mesh in (sewn_lining(clean("tank")), cape())
    ]
    assert [own_start(NewtonStepper(POTENTIAL), scene) for scene in scenes] == [None, None]
    both = sheet_above(body, walk)
    assert own_start(NewtonStepper(POTENTIAL), both) == "a sheet starts as it is given"


def test_what_has_not_come_to_rest_is_told(band_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(equilibrium, "_MOST_STEPS", 2)
    with pytest.warns(UserWarning, match=r"after 2 steps of settling it still moves by \d+\.\d mm a second \(pins="):
        rest = settled(band_scene)
    assert rest.steps == 2
    assert not rest.reached
    assert not torch.equal(rest.pos, band_scene.start(0, relaxed=False, thorough=True).pos)


class Broken:
    """An energy that is not a number."""

    def applies(self, problem: StepProblem) -> bool:
        return True

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        return problem.sum_vertices(next_pos[:, 0]) * torch.nan


def test_an_energy_without_a_value_leaves_the_cloth_where_it_was(band_scene: Scene) -> None:
    with pytest.warns(UserWarning, match="the potential has no finite value"):
        rest = settled(band_scene, potential=POTENTIAL.with_terms(broken=Broken()))
    assert not rest.reached
    assert torch.equal(rest.pos, band_scene.start(0, relaxed=False, thorough=True).pos)


def test_what_lies_still_does_not_hide_what_moves() -> None:
    """The speed is that of the fastest garment of an outfit; pinned vertices do not count."""
    tube = cylinder(8, 3, 0.1, 0.1)
    outfit = join_garments([sheet(held=True), Garment("tube", *tube, np.zeros(len(tube[0]), dtype=bool))])
    parts = equilibrium._Parts(dressed_scene(outfit, NoBody(3, 30.0)).cloth)
    moved = torch.cat([torch.full((36,), 1e-3), torch.full((24,), 5e-3)])
    moved[torch.as_tensor(outfit.pinned)] = 1.0
    assert sorted(parts.means(moved).tolist()) == pytest.approx([1e-3, 5e-3])
    assert parts.loose.tolist().count(True) == 1


def test_buttons_are_closed_while_the_cloth_settles(band_scene: Scene) -> None:
    pair = torch.tensor([[0, 2]])  # vertices of the lower rim
    gaps = []
    for closed in (None, Attachments(pair, torch.tensor([True]))):
        pos = settled(band_scene, closed).pos
        gaps.append(float((pos[0] - pos[2]).norm()))
    assert gaps[1] < 0.9 * gaps[0]


@pytest.mark.parametrize("layout", ["postcvpr", "cvpr"])
def test_weights_with_a_start_of_their_own_keep_it(layout: str, band_scene: Scene) -> None:
    simulator = import_reference_weights(make_state(layout, 4))[0].eval()
    runs = [list(simulate(simulator, band_scene, POTENTIAL, 3, metrics="none", settle=way)) for way in SETTLE_CHOICES]
    assert all(torch.equal(a.world_pos, b.world_pos) for a, b in zip(*runs, strict=True))


def test_a_start_that_is_given_is_kept(band_scene: Scene) -> None:
    start = band_scene.start(0, relaxed=False, thorough=True)
    pos = start.pos.double().numpy() + start.origin[0].numpy()
    given = replace(band_scene, start_pos=pos)
    runs = [first_frame(NewtonStepper(POTENTIAL), given, way) for way in SETTLE_CHOICES]
    assert torch.equal(runs[0].world_pos, runs[1].world_pos)


def test_an_unknown_way_is_refused(band_scene: Scene) -> None:
    with pytest.raises(ValueError, match="settle is 'soon'; choose equilibrium, paper"):
        first_frame(NewtonStepper(POTENTIAL), band_scene, "soon")
