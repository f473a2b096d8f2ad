"""How far a step is felt: held against closed forms, all pairs, and the schedules themselves."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from hood.assets.material import Material
from hood.cloth.cloth import Cloth, build_cloth
from hood.model.graph.hierarchy import num_passed_over
from hood.scene.scene import Scene
from hood.studies.plan.plan import diameter, reach_facts, reach_sentence, wave_speed
from hood.testing import grid


def sheet(count: int) -> Cloth:
    pos, faces = grid(count, count)
    return build_cloth(pos, faces, Material())


def test_waves_have_the_speed_of_the_fabric() -> None:
    fabric = Material()
    stiffness = (fabric.lame_lambda + 2 * fabric.lame_mu) * fabric.thickness
    assert wave_speed(sheet(6)) == pytest.approx(np.sqrt(stiffness / fabric.density), rel=1e-5)


def test_a_finer_mesh_is_felt_over_more_edges() -> None:
    coarse, fine = (reach_facts(sheet(count), 1 / 30) for count in (11, 21))
    assert fine["influence_edges"] == pytest.approx(2 * coarse["influence_edges"], rel=0.02)
    assert reach_facts(sheet(11), 1 / 60)["influence_edges"] == pytest.approx(coarse["influence_edges"] / 2)
    assert fine["needed_edges"] == min(fine["influence_edges"], fine["diameter_edges"])


def test_the_diameter_is_that_of_all_pairs(tank_scene: Scene) -> None:
    cloth = tank_scene.cloth
    first, second = cloth.edges.numpy().T
    graph = coo_matrix((np.ones(len(first)), (first, second)), shape=(cloth.num_vertices,) * 2).tocsr()
    exact = int(dijkstra(graph, directed=False, unweighted=True).max())
    assert exact / 2 <= diameter(cloth) <= exact
    assert diameter(cloth) >= 0.9 * exact


def test_schedules_that_reach_so_far_are_named() -> None:
    facts = reach_facts(sheet(11), 1 / 30)
    by_name = {one["name"]: one for one in facts["models"]}
    assert (by_name["small-fine15"]["radius"], by_name["small-fine15"]["levels"]) == (15, 0)
    assert (by_name["small-ours"]["radius"], by_name["small-ours"]["levels"]) == (48, 2)
    for one in facts["models"]:
        assert one["suffices"] == (one["radius"] >= facts["needed_edges"])
    far = reach_sentence(facts | {"models": [one | {"suffices": False} for one in facts["models"]]})
    assert "schedules that do: none" in far
    assert "small-ours (48)" in far


def test_where_fine_levels_are_passed_over_schedules_reach_farther(monkeypatch: pytest.MonkeyPatch) -> None:
    model = {"schedule": "ours", "coarse_edge": 0.04}
    monkeypatch.setattr("hood.studies.plan.plan.read_header", lambda path: {"model": json.dumps(model)})
    cloth = sheet(65)  # edges of 19 mm: coarse ones would have 38
    assert num_passed_over(cloth.mean_edge, 0.04) == 1
    assert {one["radius"] for one in reach_facts(cloth, 1 / 30)["models"]} == {96}
    assert {one["radius"] for one in reach_facts(sheet(11), 1 / 30)["models"]} == {48}


def test_edges_are_means_at_rest() -> None:
    cloth = sheet(3)
    lengths = (cloth.rest_pos[cloth.edges[:, 0]] - cloth.rest_pos[cloth.edges[:, 1]]).norm(dim=1)
    assert cloth.mean_edge == pytest.approx(float(torch.mean(lengths)))
