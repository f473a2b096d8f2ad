"""What is done to a mesh before it is simulated: vertices that almost coincide with a neighbour, flat faces, open seams."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

import hood
from hood.assets.files.library import names
from hood.assets.fitting.alterations import OPENING, join_short_edges, part_open_seams, turn_flat_faces
from hood.assets.garment.garment import Garment, load_garment, save_garment
from hood.studies.envelope.extreme_garments import FAULTS


@pytest.fixture(scope="module")
def tank() -> Garment:
    return load_garment("tank")


@pytest.fixture(scope="module")
def doubled(tank: Garment) -> Garment:
    """With twenty further vertices 1 µm from one of the others."""
    return FAULTS["duplicates"](tank, 20.0, np.random.default_rng(0))


def as_sets(faces: np.ndarray) -> set[frozenset[int]]:
    return {frozenset(face) for face in faces.tolist()}


def test_faces_take_the_neighbour_and_vertices_keep_their_numbers(tank: Garment, doubled: Garment) -> None:
    joined, count = join_short_edges(doubled)
    assert count == 20
    assert np.array_equal(joined.rest_pos, doubled.rest_pos)
    assert as_sets(joined.faces) == as_sets(tank.faces)
    assert len(joined.faces) == len(tank.faces)
    assert join_short_edges(joined) == (joined, 0)


def test_a_garment_without_them_is_the_same_object(tank: Garment) -> None:
    assert join_short_edges(tank)[0] is tank


def test_edges_of_no_length_are_not_hidden(tank: Garment) -> None:
    pos = tank.rest_pos.copy()
    one, other = tank.faces[0, :2]
    pos[one] = pos[other]
    assert join_short_edges(replace(tank, rest_pos=pos))[1] == 0


def test_what_a_vertex_is_goes_over_to_the_one_that_is_taken(doubled: Garment) -> None:
    last = len(doubled.rest_pos) - 1
    near = int(np.linalg.norm(doubled.rest_pos[: last - 19] - doubled.rest_pos[last], axis=1).argmin())
    pinned = np.zeros(len(doubled.rest_pos), dtype=bool)
    pinned[last] = True
    panels = {"front": np.arange(len(doubled.faces)) % 2 == 0}
    pairs = {"zip": np.array([[last, 5], [last, near]])}
    joined, _ = join_short_edges(replace(doubled, pinned=pinned, panels=panels, fasteners=pairs))
    assert joined.pinned[near]
    assert joined.panels is not None
    assert len(joined.panels["front"]) == len(joined.faces)
    assert joined.fasteners is not None
    assert joined.fasteners["zip"].tolist() == [[near, 5]]


def test_the_solver_meets_its_target_with_them(tmp_path: Path, doubled: Garment) -> None:
    save_garment(tmp_path / "doubled.npz", doubled)
    with pytest.warns(UserWarning, match="'doubled': 20 vertices lie within 0.001 of an edge's length of a neighbour"):
        simulation = hood.simulate(tmp_path / "doubled.npz", "plie", stepper="newton", num_frames=6, metrics="strain")
    frames = list(simulation)
    usual = list(hood.simulate("tank", "plie", stepper="newton", num_frames=6, metrics="strain"))
    assert all(frame.metrics["solver_converged"] == 1.0 for frame in frames[1:])
    assert frames[-1].metrics["strain_p99"] == pytest.approx(usual[-1].metrics["strain_p99"], abs=5e-3)
    there, here = (np.asarray(rolled[-1].world_pos)[: len(doubled.rest_pos) - 20] for rolled in (frames, usual))
    assert np.median(np.linalg.norm(there - here, axis=1)) < 1e-3


@pytest.fixture(scope="module")
def torn(tank: Garment) -> Garment:
    """In two bands whose edges lie on each other."""
    return FAULTS["components"](tank, 2.0, np.random.default_rng(0))


def doubled_pairs(garment: Garment) -> np.ndarray:
    return cKDTree(garment.rest_pos).query_pairs(1e-6, output_type="ndarray")


def test_open_seams_are_drawn_back_within_the_cloth(torn: Garment) -> None:
    pairs = doubled_pairs(torn)
    assert len(pairs) > 20
    parted, count = part_open_seams(torn)
    assert count == len(np.unique(pairs))
    moved = np.linalg.norm(parted.rest_pos - torn.rest_pos, axis=1)
    assert np.array_equal(np.flatnonzero(moved), np.unique(pairs))
    assert moved.max() <= 1.001 * OPENING
    gaps = np.linalg.norm(parted.rest_pos[pairs[:, 0]] - parted.rest_pos[pairs[:, 1]], axis=1)
    assert gaps.min() > 0.5 * OPENING  # a jagged edge is not drawn back straight
    assert part_open_seams(parted)[0] is parted


@pytest.mark.parametrize("name", names("garments"))
def test_embedded_garments_are_left_alone(name: str) -> None:
    garment = load_garment(name)
    assert join_short_edges(garment)[0] is garment
    assert turn_flat_faces(garment)[0] is garment
    assert part_open_seams(garment)[0] is garment


def test_what_fasteners_hold_together_stays(torn: Garment) -> None:
    assert part_open_seams(replace(torn, fasteners={"zip": doubled_pairs(torn)}))[1] == 0


def test_the_worn_shape_changes_with_the_rest_shape(torn: Garment) -> None:
    turned = torn.rest_pos @ np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    parted, _ = part_open_seams(replace(torn, skin_pos=turned))
    assert parted.skin_pos is not None
    moves = np.linalg.norm(parted.rest_pos - torn.rest_pos, axis=1), np.linalg.norm(parted.skin_pos - turned, axis=1)
    np.testing.assert_allclose(*moves, atol=1e-7)


@pytest.mark.usefixtures("compiled_layers")
def test_the_solver_meets_its_target_on_torn_cloth(tmp_path: Path, torn: Garment) -> None:
    save_garment(tmp_path / "torn.npz", torn)
    with pytest.warns(UserWarning, match="vertices lie on others along open seams.*hood prepare"):
        simulation = hood.simulate(tmp_path / "torn.npz", "plie", stepper="newton", num_frames=6, metrics="strain")
    rows = [frame.metrics for frame in simulation]
    assert all(row["solver_converged"] == 1.0 for row in rows[1:])
    assert max(row["strain_p99"] for row in rows) < 0.25


@pytest.mark.usefixtures("compiled_layers")
def test_the_solver_meets_its_target_on_slivers(tmp_path: Path, tank: Garment) -> None:
    """Ten faces a million times longer than high: of sixty steps it met none, at six seconds each."""
    slivers = FAULTS["slivers"](tank, 1e6, np.random.default_rng(0))
    panels = {"front": slivers.rest_pos[slivers.faces].mean(axis=1)[:, 2] > 0}
    turned, count = turn_flat_faces(replace(slivers, panels=panels))
    assert count == 10
    assert turned.panels is not None
    assert len(turned.panels["front"]) == len(turned.faces) == len(slivers.faces) - 1  # one of them is at the hem
    assert np.array_equal(turned.rest_pos, slivers.rest_pos)
    save_garment(tmp_path / "slivers.npz", slivers)
    with pytest.warns(UserWarning, match="10 faces are lower than 0.001 of their length"):
        simulation = hood.simulate(tmp_path / "slivers.npz", "plie", stepper="newton", num_frames=6, metrics="strain")
    rows = [frame.metrics for frame in simulation]
    assert all(row["solver_converged"] == 1.0 for row in rows[1:])
    assert max(row["solver_iterations"] for row in rows[1:]) < 30
