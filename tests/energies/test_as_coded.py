"""The published code's energies, written down once more from what is known of it, vertex by vertex and face by face."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from hood.app.settings.compose import build, load_config
from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.material import Material
from hood.assets.motion.sequence import PoseSequence
from hood.cloth.state import State
from hood.contact.contact import LaggedContact, find_contact
from hood.energies.contact import CentroidCollision
from hood.energies.friction import CodedFriction, WeightFriction
from hood.energies.potential import coded_potential
from hood.energies.problem import StepProblem
from hood.scene.scene import build_scene

G, COEFFICIENT, RADIUS, WEIGHT, EPSILON = 9.81, 0.5, 3e-3, 5e5, 2e-3


@dataclass
class Case:
    """One step of a garment on a body, as plain numbers."""

    problem: StepProblem
    rest: np.ndarray
    faces: np.ndarray
    body_faces: np.ndarray
    body: tuple[Tensor, Tensor, Tensor]  # (W, 3) at t - 1, t, t + 1
    pos: Tensor  # where the energies are compared
    found: dict[int, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)  # see nearest()


#: Garment, first frame of the walk, frame of the window, noise [m] and stretch about the middle.
KINDS = {
    "shirt, walking": ("tshirt", 60, 2e-3, 1.0),
    "skirt, walking, rumpled": ("skirt", 60, 2e-3, 1.0),
    "tank, off the body and stretched": ("tank", 20, 1e-3, 1.15),
}
STATES = {f"{kind}, frame {frame}": (*values, frame) for kind, values in KINDS.items() for frame in range(2, 9)}


@pytest.fixture(scope="module", params=STATES)
def case(request: pytest.FixtureRequest, garments: dict[str, Garment], body: Body, walk: PoseSequence) -> Case:
    name, first, noise, stretch, frame = STATES[request.param]
    garment = garments[name]
    scene = build_scene(garment, body, walk.window(first, first + 12), dtype=torch.float64)
    rng = np.random.default_rng(len(name))
    state = scene.start(frame)
    shaken = state.pos + noise * torch.as_tensor(rng.normal(size=state.pos.shape))
    state = State(shaken, state.vel, state.origin)
    step = scene.step_input(frame, state)
    problem = StepProblem(scene.cloth, state, step)
    pos = shaken + step.dt * state.vel + noise * torch.as_tensor(rng.normal(size=shaken.shape))
    centre = pos.mean(dim=0)
    obstacle = step.obstacle
    assert obstacle is not None
    surfaces = (obstacle.prev_pos, obstacle.pos, obstacle.next_pos)
    return Case(problem, garment.rest_pos, garment.faces, body.faces, surfaces, centre + stretch * (pos - centre))


def nearest(case: Case, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Of every vertex at t the face of the body in ``frame`` whose centroid is nearest, and the squared distance [m²]."""
    if frame in case.found:
        return case.found[frame]
    centroids = case.body[frame][torch.as_tensor(case.body_faces)].mean(dim=1).numpy()
    squared = [((centroids - point) ** 2).sum(axis=1) for point in case.problem.state.pos.numpy()]
    case.found[frame] = np.array([row.argmin() for row in squared]), np.array([row.min() for row in squared])
    return case.found[frame]


def planes(case: Case, frame: int, face: np.ndarray) -> tuple[Tensor, Tensor]:
    """Centroids and unit normals of body faces in ``frame``."""
    a, b, c = case.body[frame][torch.as_tensor(case.body_faces[face])].unbind(dim=1)
    normal = torch.linalg.cross(b - a, c - a)
    return (a + b + c) / 3, normal / normal.norm(dim=1, keepdim=True)


def collision(case: Case, x: Tensor, lagged: bool) -> Tensor:
    """Cubic, against the plane of the face with the nearest centroid: found at t, at t + 1; lagged, found at t - 1, at t."""
    found = 0 if lagged else 1
    centroid, normal = planes(case, found + 1, nearest(case, found)[0])
    return WEIGHT * ((EPSILON - ((x - centroid) * normal).sum(dim=1)).clamp_min(0.0) ** 3).sum()


def friction(case: Case, x: Tensor) -> Tensor:
    """μ m g √(|1 - cos²| + 1e-4) ‖δ_T‖ where both *squared* distances are below 3e-3, the body from t - 1 to t."""
    face, squared = nearest(case, 0)
    (before, normal), (centroid, _) = planes(case, 0, face), planes(case, 1, face)
    centroids = case.body[1][torch.as_tensor(case.body_faces)].mean(dim=1)
    away = torch.cdist(x.detach(), centroids, compute_mode="donot_use_mm_for_euclid_dist").min(dim=1)
    normal = (normal + planes(case, 1, away.indices.numpy())[1]) / 2
    slip = (x - case.problem.state.pos) - (centroid - before)
    slip = slip - (slip * normal).sum(dim=1, keepdim=True) * normal
    size = slip.norm(dim=1)
    cosine = slip @ torch.tensor([0.0, 0.0, 1.0]).double() / size
    weight = masses(case) * G * ((1 - cosine**2).abs() + 1e-4).sqrt()
    near = torch.as_tensor(squared < RADIUS) & (away.values**2 < RADIUS)
    return (COEFFICIENT * weight * size)[near].sum()


def corners(case: Case, points: Tensor) -> tuple[Tensor, ...]:
    return points[torch.as_tensor(case.faces)].unbind(dim=1)


def face_areas(case: Case) -> Tensor:
    a, b, c = corners(case, torch.as_tensor(case.rest))
    return 0.5 * torch.linalg.cross(b - a, c - a).norm(dim=1)


def masses(case: Case) -> Tensor:
    share = torch.repeat_interleave(Material().density * face_areas(case) / 3, 3)
    return torch.zeros(len(case.rest)).double().index_add(0, torch.as_tensor(case.faces).reshape(-1), share)


def stretching(case: Case, x: Tensor, lame_lambda: float = 44400.0) -> Tensor:
    """A h (μ tr G² + ½ λ tr² G), the rest shape laid flat face by face."""
    material = Material()
    a, b, c = corners(case, torch.as_tensor(case.rest))
    along = (b - a) / (b - a).norm(dim=1, keepdim=True)
    across = torch.linalg.cross(torch.linalg.cross(b - a, c - a), along)
    across = across / across.norm(dim=1, keepdim=True)
    flat = torch.stack([torch.stack([((p - a) * axis).sum(1) for axis in (along, across)], dim=1) for p in (b, c)], dim=2)
    a, b, c = corners(case, x)
    deform = torch.stack([b - a, c - a], dim=2) @ torch.linalg.inv(flat)
    strain = 0.5 * (deform.transpose(1, 2) @ deform - torch.eye(2).double())
    trace = strain.diagonal(dim1=1, dim2=2).sum(dim=1)
    density = material.lame_mu * (strain @ strain).diagonal(dim1=1, dim2=2).sum(1) + 0.5 * lame_lambda * trace**2
    return (face_areas(case) * material.thickness * density).sum()


def bending(case: Case, x: Tensor) -> Tensor:
    """½ k l² / (4 (A₁ + A₂)) θ² with the edge's present length and no rest angle."""
    areas, sides = face_areas(case), {}
    for number, (i, j, k) in enumerate(case.faces.tolist()):
        for start, end, other in ((i, j, k), (j, k, i), (k, i, j)):
            sides.setdefault((min(start, end), max(start, end)), []).append((number, other))
    hinges = [(a, b, *first, *second) for (a, b), (first, second) in ((e, s) for e, s in sides.items() if len(s) == 2)]
    a, b, left, at_left, right, at_right = torch.tensor(hinges).unbind(dim=1)
    edge = x[b] - x[a]
    n1, n2 = torch.linalg.cross(edge, x[at_left] - x[a]), torch.linalg.cross(x[at_right] - x[a], edge)
    axis = edge / edge.norm(dim=1, keepdim=True)
    angle = torch.atan2((torch.linalg.cross(n1, n2) * axis).sum(dim=1), (n1 * n2).sum(dim=1))
    stiffness = Material().bending_stiffness * (edge**2).sum(dim=1) / (4 * (areas[left] + areas[right]))
    return (0.5 * stiffness * angle**2).sum()


def inertia(case: Case, x: Tensor) -> Tensor:
    state = case.problem.state
    away = x - state.pos - state.vel / 30
    return (masses(case)[:, None] * away**2).sum() / 2 * 30**2


def gravity(case: Case, x: Tensor) -> Tensor:
    return G * (masses(case) * x[:, 1]).sum()


TRANSCRIPTION: dict[str, Callable[[Case, Tensor], Tensor]] = {
    "stretching": stretching,
    "bending": bending,
    "inertia": inertia,
    "gravity": gravity,
    "friction": friction,
}


@pytest.mark.parametrize("lagged", [False, True], ids=["postcvpr", "cvpr"])
def test_energies_and_gradients_are_those_of_the_transcription(case: Case, lagged: bool) -> None:
    potential = coded_potential(collision_lagged=lagged)
    problem = potential.prepare(case.problem)
    x = case.pos.clone().requires_grad_(True)
    expected = {name: term(case, x) for name, term in TRANSCRIPTION.items()} | {"collision": collision(case, x, lagged)}
    energies = potential.energies(problem, case.pos)
    assert energies.keys() == expected.keys()
    for name, energy in expected.items():
        assert float(energy.detach()) != 0, name
        assert float(energies[name]) == pytest.approx(float(energy.detach()), rel=1e-6), name
        (slope,) = torch.autograd.grad(energy, x)
        mine = type(potential)({name: potential.terms[name]}).gradient(problem, case.pos)[0]
        assert float((mine - slope).abs().max()) <= 1e-6 * float(slope.abs().max()), name


def test_the_membrane_of_the_fine_weights_has_almost_no_lambda(case: Case) -> None:
    """λ times the bending stiffness: 1.76 Pa in place of 44,400 Pa; the fabric that a network is shown stays."""
    potential = build(load_config("train", ["losses=released_fine"]).losses)
    problem = potential.prepare(case.problem)
    assert potential.prepare(problem) is problem
    x = case.pos.clone().requires_grad_(True)
    soft, full = (stretching(case, x, lame_lambda) for lame_lambda in (44400.0 * 3.9626e-5, 44400.0))
    (slope,) = torch.autograd.grad(soft, x)
    alone = type(potential)({"stretching": potential.terms["stretching"]})
    for asked in (problem, case.problem):  # it does not have to be prepared
        mine, energies = alone.gradient(asked, case.pos)
        assert float(energies["stretching"]) == pytest.approx(float(soft.detach()), rel=1e-6)
        assert float((mine - slope).abs().max()) <= 1e-6 * float(slope.abs().max())
    assert float(full.detach()) > 1.1 * float(soft.detach())
    assert problem.cloth.vertex_fabric is case.problem.cloth.vertex_fabric
    assert float(problem.cloth.lame_lambda.mean()) == pytest.approx(1.7594, rel=1e-4)
    again = potential.prepare(StepProblem(case.problem.cloth, case.problem.state, case.problem.step))
    assert again.cloth is problem.cloth  # so that what was computed from it is found again
    copied = potential.prepare(replace(problem, cloth=replace(problem.cloth)))
    torch.testing.assert_close(copied.cloth.lame_lambda, problem.cloth.lame_lambda)  # and not softened twice


def test_the_two_frictions_and_the_two_collisions_differ(case: Case) -> None:
    """What is told apart is not nothing: the comparison above would notice either."""
    problem = coded_potential().prepare(case.problem)
    contact = problem.contact
    assert isinstance(contact, LaggedContact)
    coded = CodedFriction().greatest(problem, case.pos) > 0
    meant = WeightFriction().normal_force(problem, contact) > 0
    assert int(coded.sum()) >= 5 * int(meant.sum())
    now, behind = (float(CentroidCollision(lagged=lagged)(problem, case.pos, case.pos)) for lagged in (False, True))
    assert abs(now - behind) > 1e-3 * max(now, behind)


def test_a_shirt_is_held_all_over(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    """Known of the published code: it acts on nearly every vertex of a shirt, few of which touch the skin."""
    scene = build_scene(garments["tshirt"], body, walk.window(0, 3))
    state = scene.start(0)
    step = scene.step_input(0, state)
    problem = coded_potential().prepare(StepProblem(scene.cloth, state, step))
    assert problem.contact is not None
    held = CodedFriction().greatest(problem, state.pos) > 0
    assert float(held.double().mean()) > 0.99
    assert step.obstacle is not None
    dist = find_contact(state.pos, scene.cloth.vertex_scene, step.obstacle).dist
    assert float((dist < 3e-3).double().mean()) < 0.1


@pytest.mark.parametrize("lagged", [False, True])
def test_configured_and_built_in_are_the_same(lagged: bool) -> None:
    words = ["losses=reference_as_coded", f"losses.terms.collision.lagged={str(lagged).lower()}"]
    configured, built_in = build(load_config("rollout", words).losses), coded_potential(collision_lagged=lagged)
    assert configured.terms.keys() == built_in.terms.keys()
    for name, term in built_in.terms.items():
        assert type(configured.terms[name]) is type(term)
        assert vars(configured.terms[name]) == vars(term)


def test_searched_once_and_demanded(case: Case) -> None:
    potential = coded_potential(collision_lagged=True)
    with pytest.raises(ValueError, match=r"Potential\.prepare"):
        potential.total(case.problem.with_contact(), case.pos)
    prepared = potential.prepare(case.problem)
    assert potential.prepare(prepared) is prepared
    nowhere = replace(case.problem, step=replace(case.problem.step, obstacle=None))
    assert potential.prepare(nowhere) is nowhere
    assert not {"collision", "friction"} & potential.energies(nowhere, case.pos).keys()
    ramped = CentroidCollision(5e3, 1e-3, lagged=True).with_weight(5e5)
    assert (ramped.weight, ramped.epsilon, ramped.lagged) == (5e5, 1e-3, True)
    assert CodedFriction().with_weight(1.0).radius == 3e-3
    with pytest.raises(ValueError, match="radius"):
        CodedFriction(radius=0.0)


def test_what_the_solver_is_given_of_the_coded_friction(case: Case) -> None:
    """Its gradient is that of autograd, its matrices are no less than the second derivative, vertex by vertex."""
    term = CodedFriction()
    problem = coded_potential().prepare(case.problem)
    x = case.pos.clone().requires_grad_(True)
    (slope,) = torch.autograd.grad(term(problem, x, x).sum(), x, create_graph=True)
    form = term.closed_form(problem)
    gradient, matrix = form.derivatives(case.pos)
    torch.testing.assert_close(form.energy(case.pos), term(problem, case.pos, case.pos))
    torch.testing.assert_close(gradient, slope.detach(), rtol=1e-9, atol=1e-12)
    rows = [torch.autograd.grad(slope[:, axis].sum(), x, retain_graph=True)[0] for axis in range(3)]
    left = torch.linalg.eigvalsh(matrix - torch.stack(rows, dim=1))
    assert float(left.min()) >= -1e-9 * float(matrix.abs().max())
