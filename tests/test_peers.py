"""The comparison with other simulators, as far as it runs without them: scenes, the fabric in their terms, the table."""

from __future__ import annotations

import builtins
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.energies.bending import Bending
from hood.energies.membrane import Stretching
from hood.energies.potential import Potential, default_potential
from hood.mesh.topology import unique_edges
from hood.testing import grid, make_problem

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def peers():
    """``benchmarks/peers.py``, which imports what lies beside it by its name."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        import peers

        yield peers
    finally:
        sys.path.remove(str(BENCHMARKS))


@pytest.fixture(scope="module")
def scenes(peers):
    return sys.modules["peer_scenes"]


@pytest.fixture(scope="module")
def newton(peers):
    return sys.modules["peer_newton"]


@pytest.fixture(scope="module")
def laws(peers):
    return sys.modules["peer_laws"]


@pytest.mark.parametrize("side", [12, 32])
def test_a_sheet_hangs_unstretched_from_two_corners(scenes, side):
    sheet = scenes.sheet(side)
    hung = sheet.skin_pos[sheet.pinned]
    assert hung.shape == (2, 3)
    assert np.abs(hung[1] - hung[0] - [scenes.WIDTH, 0, 0]).max() < 1e-9
    edges = unique_edges(sheet.faces)
    longer = np.diff(sheet.skin_pos[edges], axis=1) ** 2
    assert (
        np.sqrt(longer.sum(axis=-1)).ravel().max()
        <= np.linalg.norm(np.diff(sheet.rest_pos[edges], axis=1), axis=-1).max() + 1e-6
    )


def test_a_setting_starts_every_method_from_the_same_place(peers, scenes):
    setting = scenes.make_setting("drape_1k", 3, default_potential())
    starts = [peers.Hood(setting, name, default_potential()).now() for name in ("newton", "guess+1")]
    for start in starts:
        assert np.abs(start.pos - setting.start.pos).max() < 1e-12
    assert setting.body.shape == (3, 0, 3)
    with pytest.raises(ValueError, match="'tent': choose of drape_1k, drape_4k, curtain_1k, body"):
        scenes.make_setting("tent", 3, default_potential())


def test_a_strip_stretches_as_the_membrane_says(scenes):
    """A sheet pulled along x whose sides are free: force by strain and width is E h, narrowing by stretching is ν."""
    law = scenes.membrane(scenes.FABRIC)
    strain = 1e-5
    pos, faces = grid(3, 3, 1.0)
    cloth = build_cloth(pos, faces, scenes.FABRIC, dtype=torch.float64)
    pulled = torch.as_tensor(pos * np.array([1.0 + strain, 1.0, 1.0 - law.poisson * strain]))
    gradient, _ = Potential({"stretching": Stretching()}).gradient(make_problem(cloth), pulled)
    right = torch.as_tensor(pos[:, 0] == 1.0)
    assert float(gradient[right, 0].sum()) == pytest.approx(law.young * strain, rel=1e-3)
    assert float(gradient[:, 2].abs().max()) < 1e-3 * law.young * strain


def test_springs_pull_as_the_membrane_at_equal_triangles(scenes):
    """Van Gelder: with equilateral faces E h √3 / 2 inside and half of that at the rim."""
    height = np.sqrt(3.0) / 2.0
    pos = np.array([[0, 0, 0], [1, 0, 0], [0.5, 0, height], [0.5, 0, -height]], dtype=np.float64)
    faces = np.array([[0, 2, 1], [0, 1, 3]])
    stiffness = scenes.spring_stiffness(pos, faces, np.array([[0, 1], [2, 1]]), 8.0)
    assert stiffness == pytest.approx([8.0 * height, 4.0 * height])


def test_a_linear_contact_gives_way_as_far_as_the_cubic_one(scenes):
    cloth = build_cloth(*grid(4, 4), scenes.FABRIC, dtype=torch.float64)
    weight, force = 5e5, 10.0 * 9.81 * float(cloth.mass.mean())
    depth = force / scenes.contact_stiffness(cloth, weight)
    assert 3.0 * weight * depth**2 == pytest.approx(force)


def test_hinges_are_as_stiff_as_the_energy_says(scenes):
    """E = ½ K θ², of a sheet of two faces that is folded by θ."""
    pos = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0.5], [-1, 0, 0.5]], dtype=np.float64)
    cloth = build_cloth(pos, np.array([[0, 1, 2], [1, 0, 3]]), scenes.FABRIC, dtype=torch.float64)
    angle = 0.3
    folded = torch.as_tensor(pos)
    folded[2] = torch.tensor([np.cos(angle), np.sin(angle), 0.5])
    energy = float(Bending()(make_problem(cloth), folded, torch.zeros_like(folded)))
    assert energy == pytest.approx(0.5 * scenes.hinge_stiffness(cloth)[0] * angle**2)


def test_the_membrane_of_vbd_is_hoods_in_small_strain_and_another_beyond(laws, scenes):
    cloth = build_cloth(*grid(4, 3), scenes.FABRIC, dtype=torch.float64)
    problem, drawn = make_problem(cloth), np.random.default_rng(0).normal(size=(12, 3)) * [1.0, 0.0, 1.0]

    def energies(size: float) -> tuple[float, float]:
        pos = cloth.rest_pos + size * torch.as_tensor(drawn)
        return tuple(float(term(problem, pos, torch.zeros_like(pos))) for term in (Stretching(), laws.NeoHookean()))

    ours, theirs = energies(1e-6)
    assert theirs == pytest.approx(ours, rel=1e-3)
    ours, theirs = energies(3e-2)
    assert abs(theirs / ours - 1.0) > 1e-2


def test_the_membrane_of_vbd_is_an_energy_of_shape(laws):
    term = laws.NeoHookean()
    cloth = build_cloth(*grid(4, 3), Material(), dtype=torch.float64)
    pos = cloth.rest_pos + 0.02 * torch.randn(12, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    gradient, _ = Potential({"term": term}).gradient(make_problem(cloth), pos)
    assert float(gradient.sum(dim=0).abs().max()) < 1e-12 * float(gradient.abs().sum())


def _gradient(term, cloth, pos):
    gradient, _ = Potential({"term": term}).gradient(make_problem(cloth), pos)
    return gradient


def test_the_membrane_of_style3d_is_hoods_in_shear_and_in_a_free_strip(laws, scenes):
    strain, law = 1e-5, scenes.membrane(scenes.FABRIC)
    pos, faces = grid(4, 4, 1.0)
    cloth = build_cloth(pos, faces, scenes.FABRIC, dtype=torch.float64)
    term, here = laws.BaraffWitkin(cloth, law), torch.as_tensor(pos)
    sheared = here.clone()
    sheared[:, 0] += strain * here[:, 2]
    ours, theirs = _gradient(Stretching(), cloth, sheared), _gradient(term, cloth, sheared)
    assert float((theirs - ours).abs().max()) < 1e-3 * float(ours.abs().max())
    for axis in (0, 2):
        pulled = here.clone()
        pulled[:, axis] *= 1.0 + strain
        end = here[:, axis] == here[:, axis].max()
        force = _gradient(term, cloth, pulled)
        assert float(force[end, axis].sum()) == pytest.approx(law.young * strain, rel=1e-3)
        assert float(force[:, 2 - axis].abs().max()) < 1e-3 * law.young * strain


def test_the_bending_of_style3d_is_hoods_where_hinges_are_hardly_folded(laws, scenes):
    cloth = build_cloth(*grid(5, 4), scenes.FABRIC, dtype=torch.float64)
    pos = cloth.rest_pos.clone()
    pos[:, 1] += 1e-6 * torch.as_tensor(np.random.default_rng(0).normal(size=len(pos)))
    ours, theirs = _gradient(Bending(), cloth, pos), _gradient(laws.FlatBending(cloth), cloth, pos)
    assert float((theirs - ours)[:, 1].abs().max()) < 1e-3 * float(ours.abs().max())


def test_the_panels_of_style3d_are_the_faces_at_rest(peers):
    rest = np.random.default_rng(0).normal(size=(9, 3))
    faces = np.arange(9).reshape(3, 3)
    flat = sys.modules["peer_style3d"].panels(rest, faces)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        lengths = np.linalg.norm(rest[faces[:, a]] - rest[faces[:, b]], axis=1)
        assert np.linalg.norm(flat[:, a] - flat[:, b], axis=1) == pytest.approx(lengths)
    assert (np.linalg.det(flat[:, 1:] - flat[:, :1]) > 0).all()


def test_newton_takes_the_fabric_as_it_is_said_to_style3d(newton, laws, scenes):
    """The forces of its kernels on a crumpled sheet; those of its shear to the first order in strain."""
    pytest.importorskip("newton")
    import warp
    from newton._src.solvers.style3d import kernels

    setting = scenes.make_setting("drape_1k", 2, default_potential())
    cloth, law = setting.cloth, scenes.membrane(setting.fabric)
    model = newton.Newton(setting, newton.Effort("style3d", 1, 1)).model
    step = torch.randn(cloth.rest_pos.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    pos = torch.as_tensor(setting.start.pos) + 1e-4 * step
    there = warp.array(pos.numpy().astype(np.float32), dtype=warp.vec3, device="cpu")
    style = model.style3d
    stretch = (there, model.tri_areas, model.tri_poses, model.tri_indices, style.tri_aniso_ke)
    bend = (there, style.edge_rest_area, style.edge_bending_cot, model.edge_indices, model.edge_bending_properties)
    terms = (laws.BaraffWitkin(cloth, law), laws.FlatBending(cloth))
    for kernel, arguments, term in zip(
        (kernels.eval_stretch_kernel, kernels.eval_bend_kernel), (stretch, bend), terms, strict=True
    ):
        forces = warp.zeros(len(pos), dtype=warp.vec3, device="cpu")
        warp.launch(kernel, dim=len(arguments[1]), inputs=list(arguments), outputs=[forces], device="cpu")
        ours = -_gradient(term, cloth, pos).numpy()
        assert np.abs(forces.numpy() - ours).max() < 1e-2 * np.abs(ours).max()


def test_layers_are_kept_apart_where_they_are_asked_for(peers, scenes, newton):
    potential = scenes.make_potential(self_contact=True)
    setting = scenes.make_setting("drape_1k", 2, potential)
    assert setting.self_contact
    assert not scenes.make_setting("drape_1k", 2, scenes.make_potential(self_contact=False)).self_contact
    with pytest.raises(scenes.CannotDoError, match="keeps particles apart"):
        peers.make_method("xpbd:1x1", setting, potential)


def test_a_row_says_what_was_measured(peers, scenes):
    row = scenes.Row("newton", 12.34, 0.0567, 0.0123, 4.2e-3, 2.0, 0.5, float("nan"), 1.5e-3)
    assert peers.line(row).split() == ["newton", "12.3", "0.057", "1.23%", "4.2", "2", "0.5", "-", "1.50"]
    assert len(peers.line(row)) == len(peers.HEADER)


def test_frames_are_measured_every_stride_and_at_the_end(scenes):
    assert list(scenes.measured_frames(12, 5)) == [5, 10, 11]


def test_a_package_that_is_missing_is_named_with_the_command(newton, peers, monkeypatch):
    known = builtins.__import__

    def without(name, *args, **kwargs):
        if name in ("newton", "mujoco"):
            raise ImportError(f"No module named {name!r}")
        return known(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(SystemExit, match="pip install newton==1.8.0 warp-lang==1.19.0"):
        newton.packages()
    with pytest.raises(SystemExit, match="pip install mujoco==4.0.0"):
        peers.peer_mujoco.package()
