"""Fabrics as numbers or fields: by which rule they reach vertices, faces and edges, and what the energies make of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np
import pytest
import torch

from hood.assets.material import EdgeField, FaceField, Field, Material, values_of
from hood.cloth.cloth import Cloth, build_cloth, concatenate_cloths
from hood.cloth.fabric import patchwork
from hood.energies.bending import Bending
from hood.energies.membrane import Stretching
from hood.energies.potential import default_potential
from hood.mesh import topology
from hood.solver.newton import NewtonSettings
from hood.steppers.newton import implicit_euler
from hood.testing import cylinder, fold, grid, make_problem, sphere, strip

F64 = torch.float64
PLACES: dict[str, Callable[[np.ndarray], Field]] = {"vertices": lambda v: v, "faces": FaceField, "edges": EdgeField}


def counts(mesh: tuple[np.ndarray, np.ndarray]) -> dict[str, int]:
    return {"vertices": len(mesh[0]), "faces": len(mesh[1]), "edges": len(topology.unique_edges(mesh[1]))}


def random_material(mesh: tuple[np.ndarray, np.ndarray], place: str, seed: int = 0) -> Material:
    """Fields on one kind of element, within a factor of two of the default fabric."""
    rng, base, count = np.random.default_rng(seed), Material(), counts(mesh)[place]
    return Material(**{name: PLACES[place](getattr(base, name) * rng.uniform(0.7, 1.4, count)) for name in Material.names()})


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("mesh", [cylinder(8, 5), grid(4, 4), sphere(1)], ids=["tube", "sheet", "ball"])
def test_uniform_fields_equal_numbers(place: str, mesh: tuple[np.ndarray, np.ndarray]) -> None:
    base = Material()
    as_fields = {name: PLACES[place](np.full(counts(mesh)[place], getattr(base, name))) for name in Material.names()}
    numbers, arrays = (build_cloth(*mesh, m, dtype=F64) for m in (base, Material(**as_fields)))
    for spec in fields(numbers):
        torch.testing.assert_close(getattr(arrays, spec.name), getattr(numbers, spec.name), rtol=1e-12, atol=0)


def test_a_field_is_used_exactly_where_it_is_needed() -> None:
    mesh = cylinder(7, 4)
    on_faces, on_edges = random_material(mesh, "faces"), random_material(mesh, "edges", 1)
    cloth = build_cloth(*mesh, on_faces, dtype=F64)
    for name in ("density", "thickness", "lame_mu", "lame_lambda"):
        assert getattr(cloth, name).tolist() == getattr(on_faces, name).values.tolist()
    cloth = build_cloth(*mesh, on_edges, dtype=F64)
    value = {tuple(edge): k for edge, k in zip(cloth.edges.tolist(), on_edges.bending_stiffness.values, strict=True)}
    assert cloth.bending_stiffness.tolist() == [value[(a, b)] for a, b, *_ in cloth.hinges.tolist()]
    assert cloth.edge_fabric[:, 2].tolist() == on_edges.bending_stiffness.values.tolist()


def test_every_rule_by_hand() -> None:
    """Two faces of areas 1 and 2 over the edge 1-2; edges 0-1, 0-2, 1-2, 1-3, 2-3; vertex 4 is isolated."""
    pos = np.array([[-1, 0, 0], [0, 0, 0], [0, 0, 2], [2, 0, 0], [9, 9, 9.0]])
    faces = np.array([[0, 1, 2], [3, 2, 1]])
    per_face, per_edge, per_vertex = np.array([3.0, 6.0]), np.array([1.0, 2.0, 4.0, 8.0, 16.0]), np.array([1, 2, 4, 8, 16.0])

    def cloth_of(values: Field) -> Cloth:
        same = {name: values for name in ("density", "lame_mu", "bending_stiffness", "thickness")}
        return build_cloth(pos, faces, Material(**same, lame_lambda=0.0), dtype=F64)

    cloth = cloth_of(FaceField(per_face))
    assert cloth.vertex_fabric[:, 0].tolist() == pytest.approx([3.0, 5.0, 5.0, 6.0, 5.0])
    assert cloth.edge_fabric[:, 2].tolist() == pytest.approx([3.0, 3.0, 4.5, 6.0, 6.0])
    assert cloth.bending_stiffness.tolist() == pytest.approx([4.5])
    assert cloth.mass.tolist() == pytest.approx([1.0, 5.0, 5.0, 4.0, 0.0])  # a third of 3 kg and of 12 kg

    cloth = cloth_of(EdgeField(per_edge))
    assert cloth.lame_mu.tolist() == pytest.approx([7 / 3, 28 / 3])
    assert cloth.vertex_fabric[:, 2].tolist() == pytest.approx([1.5, 13 / 3, 22 / 3, 12.0, 31 / 5])
    assert cloth.bending_stiffness.tolist() == [4.0]

    cloth = cloth_of(per_vertex)
    assert cloth.density.tolist() == pytest.approx([7 / 3, 14 / 3])
    assert cloth.edge_fabric[:, 0].tolist() == pytest.approx([1.5, 2.5, 3.0, 5.0, 6.0])
    assert cloth.bending_stiffness.tolist() == pytest.approx([3.0])
    assert cloth.vertex_fabric[:, 1].tolist() == [0.0] * 5


@pytest.mark.parametrize("place", PLACES)
def test_a_garments_stiffness_multiplies_the_membrane_alone(place: str) -> None:
    mesh = cylinder(9, 6)
    material, factors = random_material(mesh, place), np.random.default_rng(2).uniform(0.5, 3.0, len(mesh[0]))
    plain, firm, same = (
        build_cloth(*mesh, material, stiffness=given, dtype=F64) for given in (None, factors, np.ones(len(factors)))
    )
    on = {key: torch.as_tensor(factors[getattr(plain, key).numpy()].mean(axis=1)) for key in ("faces", "edges")}
    for name in ("lame_mu", "lame_lambda"):
        torch.testing.assert_close(getattr(firm, name), getattr(plain, name) * on["faces"])
    torch.testing.assert_close(firm.vertex_fabric[:, :2], plain.vertex_fabric[:, :2] * torch.as_tensor(factors)[:, None])
    torch.testing.assert_close(firm.edge_fabric[:, :2], plain.edge_fabric[:, :2] * on["edges"][:, None])
    for name in ("density", "thickness", "bending_stiffness", "mass"):
        assert torch.equal(getattr(firm, name), getattr(plain, name))
    assert all(
        torch.equal(getattr(same, spec.name), getattr(plain, spec.name))
        for spec in fields(same)
        if spec.name not in ("num_scenes", "flat")
    )
    with pytest.raises(ValueError, match=r"stiffness has shape \(3,\); give one factor per vertex"):
        build_cloth(*mesh, material, stiffness=np.ones(3))


@pytest.mark.parametrize("place", PLACES)
def test_mass_is_conserved(place: str) -> None:
    mesh = cylinder(9, 6)
    cloth = build_cloth(*mesh, random_material(mesh, place), dtype=F64)
    by_face = cloth.density * cloth.rest_area
    assert float(cloth.mass.sum()) == pytest.approx(float(by_face.sum()), rel=1e-14)
    expected = torch.zeros(len(mesh[0]), dtype=F64)
    for corner in range(3):
        expected.index_add_(0, cloth.faces[:, corner], by_face / 3)
    torch.testing.assert_close(cloth.mass, expected, rtol=1e-14, atol=0)


def test_an_edge_with_three_faces_has_one_stiffness() -> None:
    pos = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 1, 0.0]])
    faces = np.array([[0, 1, 2], [0, 1, 3], [1, 0, 4]])
    on_faces = build_cloth(pos, faces, Material(bending_stiffness=FaceField(np.array([1.0, 2.0, 6.0]))), dtype=F64)
    assert on_faces.bending_stiffness.tolist() == pytest.approx([3.0, 3.0])
    edge_values = np.arange(1.0, 8.0)
    on_edges = build_cloth(pos, faces, Material(bending_stiffness=EdgeField(edge_values)), dtype=F64)
    assert on_edges.bending_stiffness.tolist() == [1.0, 1.0]  # edge 0-1 is the first


def test_a_strip_of_two_fabrics_is_two_strips() -> None:
    """Sharp at the seam: energies are the sums of the two halves' own, and the seam bends with the edge's value."""
    pos, faces = strip(9, 0.8, 0.1)
    left = pos[faces].mean(axis=1)[:, 0] < 0.4
    soft, stiff = Material(density=0.1, lame_mu=2e4, bending_stiffness=1e-6), Material(density=0.4, lame_mu=6e4, thickness=9e-4)
    names = ("density", "lame_mu", "thickness")
    mixed = {name: FaceField(np.where(left, getattr(soft, name), getattr(stiff, name))) for name in names}
    edges = topology.unique_edges(faces)
    middle = pos[edges].mean(axis=1)[:, 0]
    seam = np.isclose(middle, 0.4)
    bending = np.where(seam, 1e-3, np.where(middle < 0.4, soft.bending_stiffness, stiff.bending_stiffness))
    cloth = build_cloth(pos, faces, Material(**mixed, bending_stiffness=EdgeField(bending)), dtype=F64)
    state = torch.as_tensor(pos * [1.1, 1.0, 0.97])

    def energy(term: Stretching | Bending, item: Cloth, at: torch.Tensor) -> float:
        return float(term(make_problem(item), at, at))

    halves = [build_cloth(pos, faces[side], m, dtype=F64) for side, m in ((left, soft), (~left, stiff))]
    assert float(cloth.mass.sum()) == pytest.approx(sum(float(half.mass.sum()) for half in halves), rel=1e-12)
    assert energy(Stretching(), cloth, state) == pytest.approx(sum(energy(Stretching(), h, state) for h in halves), rel=1e-12)
    folded = torch.as_tensor(fold(pos, 1.0))  # about the seam alone
    hinge = seam[topology.edge_index(edges, cloth.hinges[:, :2].numpy())]
    weight = 1e-3 * cloth.hinge_rest_length[hinge] ** 2 / (4 * cloth.hinge_area[hinge])
    assert energy(Bending(), cloth, folded) == pytest.approx(0.5 * float(weight.sum()), rel=1e-9)


@pytest.mark.parametrize("place", PLACES)
def test_a_batch_of_fields_equals_its_members(place: str) -> None:
    meshes = [grid(4, 4, 0.3), cylinder(5, 3), strip(3)]
    cloths = [build_cloth(*mesh, random_material(mesh, place, i), dtype=F64) for i, mesh in enumerate(meshes)]
    rng = np.random.default_rng(5)
    states = [torch.as_tensor(mesh[0] + 0.02 * rng.normal(size=mesh[0].shape)) for mesh in meshes]
    together, energies = default_potential().gradient(make_problem(concatenate_cloths(cloths)), torch.cat(states))
    alone = [default_potential().gradient(make_problem(c), s) for c, s in zip(cloths, states, strict=True)]
    torch.testing.assert_close(together, torch.cat([gradient for gradient, _ in alone]), rtol=1e-12, atol=1e-14)
    for name, value in energies.items():
        torch.testing.assert_close(value, torch.cat([e[name] for _, e in alone]), rtol=1e-12, atol=1e-18)


def test_kinds_can_be_mixed() -> None:
    mesh = grid(4, 4, 0.3)
    by = {place: random_material(mesh, place) for place in PLACES}
    mixed = Material(by["faces"].density, by["vertices"].lame_mu, by["edges"].lame_lambda, by["edges"].bending_stiffness, 5e-4)
    cloth = build_cloth(*mesh, mixed, dtype=F64)
    assert torch.equal(cloth.mass, build_cloth(*mesh, by["faces"], dtype=F64).mass)
    assert torch.equal(cloth.lame_mu, build_cloth(*mesh, by["vertices"], dtype=F64).lame_mu)
    assert torch.equal(cloth.lame_lambda, build_cloth(*mesh, by["edges"], dtype=F64).lame_lambda)
    assert cloth.thickness.unique().tolist() == [5e-4]


@pytest.mark.parametrize(
    "field, message",
    [
        (np.full(5, 0.2), r"\(5,\) on vertices; give one number, or one per vertex \(16,\)"),
        (np.full(18, 0.2), r"\(18,\) on vertices; .*\(16,\)"),
        (FaceField(np.full(16, 0.2)), r"\(16,\) on faces; .*one per face \(18,\)"),
        (EdgeField(np.full(18, 0.2)), r"\(18,\) on edges; .*one per edge \(33,\)"),
        (FaceField(np.full((18, 1), 0.2)), r"\(18, 1\) on faces"),
    ],
)
def test_a_field_of_the_wrong_length_is_refused(field: Field, message: str) -> None:
    with pytest.raises(ValueError, match="material 'density' has shape " + message):
        build_cloth(*grid(4, 4), Material(density=field))


def test_moduli_that_meet_badly_are_refused() -> None:
    """Vertices and faces are fine by themselves; on face 3 their sum is not positive."""
    mesh = grid(4, 4)
    lame_lambda = np.full(18, 0.0)
    lame_lambda[3] = -150.0
    with pytest.raises(ValueError, match=r"lame_mu \+ lame_lambda is -50.0 at face 3"):
        build_cloth(*mesh, Material(lame_mu=np.full(16, 100.0), lame_lambda=FaceField(lame_lambda)))


def test_parts_that_do_not_touch_are_garments_of_their_own_fabric() -> None:
    """Two hanging tubes of one cloth, each of its fabric, fall as each does alone."""
    pos, faces = cylinder(10, 6)
    fabrics = Material(density=0.06, bending_stiffness=4e-7), Material(density=0.45, lame_mu=5e4, bending_stiffness=3e-4)
    both = np.concatenate([pos, pos + [1.0, 0.0, 0.0]]), np.concatenate([faces, faces + len(pos)])
    second = np.arange(len(both[1])) >= len(faces)
    sewn = patchwork(fabrics[0], [(second, fabrics[1])], *both)
    held = pos[:, 1] > pos[:, 1].max() - 1e-6

    def fallen(mesh: tuple[np.ndarray, np.ndarray], material: Material, pinned: np.ndarray) -> np.ndarray:
        cloth = build_cloth(*mesh, material, pinned, dtype=F64)
        start = cloth.rest_pos * torch.tensor([1.0, 0.9, 1.05])  # creased
        steps = implicit_euler(default_potential(), make_problem(cloth, start), 5, NewtonSettings(target_rg=1e-8))
        return [step.state.pos.numpy() for step in steps][-1]

    together = fallen(both, sewn, np.tile(held, 2))
    for place, material in enumerate(fabrics):
        own = fallen((pos + [place, 0.0, 0.0], faces), material, held)
        # The start is scaled about the origin.
        np.testing.assert_allclose(together[place * len(pos) :][: len(pos)], own, rtol=0, atol=1e-6)
    assert np.abs(together[len(pos) :] - [1.0, 0.0, 0.0] - together[: len(pos)]).max() > 1e-3


def test_of_parts_that_overlap_the_last_counts() -> None:
    mesh = grid(4, 4)
    count = len(mesh[1])
    masks = np.arange(count) < 9, np.arange(count) < 4
    sewn = patchwork(Material(), [(masks[0], Material(density=0.3)), (masks[1], Material(density=0.4))], *mesh)
    np.testing.assert_allclose(sewn.density.values, [0.4] * 4 + [0.3] * 5 + [0.20022] * (count - 9))


def test_a_wide_seam_goes_from_one_fabric_to_the_other() -> None:
    """A tube: along it the share of the other fabric grows from 0 to 1 over the width; farther away nothing changes."""
    pos, faces = cylinder(24, 41)
    axis = int(np.argmax(np.ptp(pos, axis=0)))
    along = pos[faces].mean(axis=1)[:, axis]
    along = (along - along.min()) / np.ptp(along)
    length = float(np.ptp(pos[:, axis]))
    light, heavy = Material(density=0.1), Material(density=0.3)
    sharp, wide = (patchwork(light, [(along > 0.5, heavy)], pos, faces, width) for width in (0.0, 0.4 * length))
    before, after = (values_of(fabric.density)[0] for fabric in (sharp, wide))
    assert set(before.tolist()) == {0.1, 0.3}
    far = abs(along - 0.5) > 0.25
    assert (after[far] == before[far]).all()
    share = (after - 0.1) / 0.2
    steps = [share[abs(along - place) < 0.02].mean() for place in (0.36, 0.42, 0.5, 0.58, 0.64)]
    assert steps == sorted(steps)
    assert steps[2] == pytest.approx(0.5, abs=0.05)
    assert 0.0 < steps[0] < 0.1
    assert 0.9 < steps[-1] < 1.0
    # It is measured along the cloth: seen across the tube both sides are equal.
    assert np.ptp(share[abs(along - 0.42) < 0.01]) < 0.05


def test_parts_that_do_not_touch_have_no_seam() -> None:
    """Two sheets one millimetre apart: each keeps its fabric whatever the width."""
    pos, faces = grid(6, 6)
    pair = np.concatenate([pos, pos + [0.0, 1e-3, 0.0]]), np.concatenate([faces, faces + len(pos)])
    other = np.arange(len(pair[1])) >= len(faces)
    made = patchwork(Material(density=0.1), [(other, Material(density=0.3))], *pair, 1.0)
    assert values_of(made.density)[0].tolist() == np.where(other, 0.3, 0.1).tolist()
