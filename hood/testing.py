"""Synthetic meshes and reusable contracts for tests; a new energy or group of features is tested by one call of a contract.

Meshes are pairs (pos (V, 3) float64 [m], faces (F, 3) int64).
"""

from __future__ import annotations

import itertools
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from hood.assets.material import Material
from hood.cloth.cloth import Cloth, along_grain, build_cloth, concatenate_cloths, grain_of
from hood.cloth.state import Obstacle, State, StepInput
from hood.contact.contact import Contact
from hood.energies.potential import Potential, Term
from hood.energies.problem import StepProblem
from hood.mesh.shapes import Mesh as Mesh
from hood.mesh.shapes import box as box
from hood.mesh.shapes import cylinder as cylinder
from hood.mesh.shapes import grid as grid
from hood.mesh.shapes import sphere as sphere
from hood.mesh.shapes import strip as strip
from hood.model.features.groups import EdgeGroup, NodeGroup
from hood.model.features.inputs import Inputs
from hood.model.graph.builder import build_graph, build_static
from hood.model.graph.hierarchy import Hierarchy


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Uniformly random proper rotation (3, 3)."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def with_weave(cloth: Cloth, warp: float = 40.0, weft: float = 15.0, shear: float = 0.3) -> Cloth:
    """The same cloth with these factors along its warp, which runs upwards at rest; see :mod:`hood.energies.membrane`."""
    grain = torch.as_tensor(grain_of(cloth.rest_pos.double().numpy(), cloth.faces.numpy())).to(cloth.rest_pos)
    weave = cloth.rest_area.new_tensor([warp, weft, shear]).repeat(len(cloth.faces), 1)
    return replace(cloth, weave=weave, grain=grain, rest_inverse=along_grain(cloth.rest_inverse, grain))


def make_problem(
    cloth: Cloth,
    pos: Tensor | np.ndarray | None = None,
    vel: Tensor | np.ndarray | None = None,
    dt: float = 1 / 30,
    contact: Contact | None = None,
) -> StepProblem:
    """A step of ``cloth`` in its dtype, at ``pos`` (default: rest) with velocity ``vel`` (default: 0)."""
    like = cloth.rest_pos
    position = like if pos is None else torch.as_tensor(pos).to(like)
    velocity = torch.zeros_like(like) if vel is None else torch.as_tensor(vel).to(like)
    state = State(position, velocity, torch.zeros(cloth.num_scenes, 3, dtype=torch.float64))
    step = StepInput(dt=like.new_full((cloth.num_scenes,), dt))
    return StepProblem(cloth, state, step, contact, torch.tensor([0.0, -9.81, 0.0]).to(like))


def plane_contact(pos: Tensor, normal: Tensor | None = None, height: float = 0.0, motion: Tensor | None = None) -> Contact:
    """Contact of ``pos`` (V, 3) with a plane at ``height`` along ``normal`` (up) moving by ``motion``."""
    up = pos.new_tensor([0.0, 1.0, 0.0]) if normal is None else normal.to(pos)
    normals = up.expand_as(pos)
    dist = (pos * normals).sum(dim=1) - height
    point = pos - dist.unsqueeze(1) * normals
    index = torch.zeros(len(pos), dtype=torch.int64)
    return Contact(
        vertex=index,
        vertex_dist=dist.abs(),
        face=index,
        bary=pos.new_tensor([1.0, 0.0, 0.0]).expand_as(pos),
        dist=dist,
        valid=torch.ones(len(pos), dtype=torch.bool),
        point=point,
        normal=normals,
        next_point=point if motion is None else point + motion.to(pos),
        next_normal=normals,
        curvature=torch.zeros_like(dist),
    )


def concatenate_contacts(contacts: list[Contact]) -> Contact:
    """Contact of several scenes as that of one batch; what none of them has stays None."""
    values = {field.name: [getattr(contact, field.name) for contact in contacts] for field in fields(Contact)}
    joined: dict[str, Any] = {name: None if v[0] is None else torch.cat(v) for name, v in values.items()}
    return Contact(**joined)


def assert_nearest(points: Tensor, targets: Tensor, found: Tensor) -> None:
    """``targets[found]`` (N, 3) are as near to ``points`` (N, 3) as any of ``targets`` (M, 3), to ten roundings of float64.

    Which of several equally near targets is found is not promised: it follows from roundings, which differ between CPUs.
    The distances come from differences: the matrix product form |x|² − 2 x·y + |y|² cancels.
    """
    exact = (points.double()[:, None] - targets.double()).square().sum(dim=2).sqrt()
    taken = exact.gather(1, found[:, None]).squeeze(1)
    excess = taken - exact.amin(dim=1)
    bound = 10 * torch.finfo(torch.float64).eps * (taken + points.double().norm(dim=1))
    worst = int((excess - bound).argmax())
    assert bool((excess <= bound).all()), f"point {worst}: found {int(found[worst])}, {float(excess[worst]):.2g} m too far"


def without_values(item: Any) -> Any:
    """A tensor, a module (changed in place) or a record of such, without values and not on the CPU; under a FakeTensorMode."""
    if isinstance(item, Tensor):
        return torch.empty_strided(item.shape, item.stride(), dtype=item.dtype, device="meta")
    if isinstance(item, dict):
        return {name: without_values(value) for name, value in item.items()}
    if isinstance(item, nn.Module):
        for module in item.modules():
            for name, parameter in module._parameters.items():
                module._parameters[name] = None if parameter is None else nn.Parameter(without_values(parameter))
            for name, buffer in module._buffers.items():
                module._buffers[name] = None if buffer is None else without_values(buffer)
        return item
    if not is_dataclass(item):
        return item
    empty = object.__new__(type(item))
    for field in fields(item):  # unlike replace() this leaves out checks, and what was computed from the values
        object.__setattr__(empty, field.name, without_values(getattr(item, field.name)))
    return empty


#: What an energy of the cloth's own shape must attain in float64, see :func:`internal_energy_figures`.
INTERNAL_LIMITS = {
    "at_rest": 1e-20,
    "flipped_flat": 1e-20,
    "rigid_energy": 1e-12,
    "rigid_gradient": 1e-11,
    "labels": 1e-12,
    "net_force": 1e-13,
    "net_torque": 1e-13,
    "batch_energy": 1e-12,
    "batch_gradient": 1e-12,
    "finite_differences": 1e-6,
}


def assert_internal_energy_contract(term: Term, seed: int = 0, **limits: float) -> None:
    """Everything an energy of the cloth's own shape must satisfy, in float64; raises AssertionError
    otherwise.

    Zero at rest; unchanged by rigid motion, by flipped faces and by relabelling; no net force or torque;
    gradient equal to finite differences at random, flat, folded, stretched and compressed states; a batch
    gives what its members give alone; finite energy and gradient at degenerate shapes, in float32 as well.

    Args:
        limits: other bounds than :data:`INTERNAL_LIMITS`, by name.
    """
    bounds = INTERNAL_LIMITS | limits
    assert bounds.keys() == INTERNAL_LIMITS.keys(), f"unknown limits {limits.keys() - INTERNAL_LIMITS.keys()}"
    for name, figure in internal_energy_figures(term, seed).items():
        assert figure <= bounds[name], f"{name}: {figure:.3g} exceeds {bounds[name]:.3g}"
    assert_gradient(term, np.random.default_rng(seed))
    assert_finite_when_degenerate(term)


def internal_energy_figures(term: Term, seed: int = 0) -> dict[str, float]:
    """What :func:`assert_internal_energy_contract` bounds, measured: the largest over a sheet, a tube and a strip.

    ``at_rest`` [J]; ``flipped_flat`` [J], a flat sheet with every seventh face flipped; all others relative: to the energy,
    to the largest entry of the gradient (``_gradient``, ``finite_differences``), to the sum of its entries (``net_``; the
    torque about the origin, at most some decimetres away).
    """
    rng = np.random.default_rng(seed)
    rows = []
    for mesh in (_wavy_sheet(), cylinder(6, 4), strip(4)):
        cloth = build_cloth(*mesh, Material(), dtype=torch.float64)
        crumpled = mesh[0] + 0.03 * rng.normal(size=mesh[0].shape)
        rows.append(
            {
                "at_rest": float(_energy(term, cloth, cloth.rest_pos)),
                **_rigid_figures(term, cloth, crumpled, rng),
                **_balance_figures(term, cloth, crumpled),
                "labels": _label_figure(term, mesh, crumpled, rng),
            }
        )
    worst = {name: max(row[name] for row in rows) for name in rows[0]}
    worst |= {"flipped_flat": _flipped_figure(term), "finite_differences": _difference_figure(term, rng)}
    return worst | _batch_figures(term, rng)


def assert_gradient(term: Term, rng: np.random.Generator) -> None:
    """gradcheck at random, flat, folded (3 rad), stretched and compressed states of a curved sheet."""
    cloth, states = _gradient_states(rng)
    for name, state in states.items():
        pos = torch.as_tensor(state).requires_grad_(True)
        assert torch.autograd.gradcheck(lambda x: _energy(term, cloth, x), pos, atol=1e-7, rtol=1e-4), name


def assert_finite_when_degenerate(term: Term) -> None:
    """Finite energy and gradient where faces are flat, collinear, coincident, lack an edge, or are folded by π.

    With edges of 5 cm and of 0.1 mm, in float32 and float64.
    """
    for size, dtype in itertools.product((0.1, 2e-4), (torch.float32, torch.float64)):
        pos, faces = grid(3, 3, size)
        without_edge = pos.copy()
        without_edge[4] = without_edge[1]
        point = pos.copy()
        point[faces[0]] = point[faces[0, 0]]
        states = {
            "flat": pos,
            "collinear": pos * np.array([1.0, 1.0, 0.0]),
            "coincident": pos * 0.0,
            "zero-length edge": without_edge,
            "coincident face": point,
            "folded by π": np.abs(pos - pos[4]) + pos[4],
        }
        cloth = build_cloth(pos, faces, Material(), dtype=dtype)
        for name, state in states.items():
            energy, gradient = _energy_and_gradient(term, cloth, state)
            assert torch.isfinite(energy).all(), f"energy, {name}, edges of {size / 2} m, {dtype}"
            assert torch.isfinite(gradient).all(), f"gradient, {name}, edges of {size / 2} m, {dtype}"


def assert_feature_group_contract(group: NodeGroup | EdgeGroup, seed: int = 0) -> None:
    """Everything that a group of features must satisfy, in float64; raises AssertionError otherwise.

    As many rows and columns as it promises, finite, and the same wherever in the world the scene is. The step is one of a sheet
    on a moving body, with all that a group may need.
    """
    name = type(group).__name__
    assert isinstance(group, NodeGroup) == (group.of == "nodes"), f"{name}: columns of {group.of} need the other base class"
    group = group.double().eval()
    with torch.no_grad():
        inputs = feature_inputs(seed)
        here, there = group(inputs), group(feature_inputs(seed, shift=3.0))
    rows = inputs.num_cloth + inputs.num_body if group.of == "nodes" else len(getattr(inputs, group.of).senders)
    assert here.shape == (rows, group.width), f"{name}: {tuple(here.shape)} instead of ({rows}, {group.width})"
    assert bool(torch.isfinite(here).all()), f"{name}: values that are not finite"
    furthest = float((here - there).abs().max())
    assert furthest <= 1e-8, f"{name}: differs by {furthest:.2g} where the scene is 3 m away"


def feature_inputs(seed: int = 0, shift: float = 0.0) -> Inputs:
    """What groups of features read, in float64: a wavy sheet above a square body that rises, pinned at one vertex, with a
    coarse level, two edges between layers and random views of a potential; all moved by ``shift`` [m] along every axis."""
    draw = torch.Generator().manual_seed(seed)
    flat, faces = _wavy_sheet()
    cloth = build_cloth(flat, faces, Material(), np.arange(len(flat)) == 0, dtype=torch.float64)
    count, zero = len(flat), torch.zeros(4, dtype=torch.int64)

    def some(columns: int, scale: float) -> Tensor:
        return scale * torch.randn(count, columns, dtype=torch.float64, generator=draw)

    square = torch.tensor([[-1, -0.5, -1], [-1, -0.5, 1], [1, -0.5, 1], [1, -0.5, -1.0]], dtype=torch.float64) + shift
    rise = torch.tensor([0.0, 0.01, 0.0], dtype=torch.float64)
    sides = torch.tensor([[0, 1, 2], [0, 2, 3]])
    obstacle = Obstacle(square, square + rise, square - rise, sides, zero, zero[:2], zero.bool())
    pos, step = cloth.rest_pos + some(3, 1e-3) + shift, StepInput(torch.tensor([1 / 30], dtype=torch.float64), obstacle)
    state = State(pos, some(3, 1.0), torch.zeros(1, 3, dtype=torch.float64))
    contact = plane_contact(pos, height=shift - 0.5, motion=rise)
    level = torch.zeros(count, dtype=torch.int64)
    level[:2] = 1
    static = build_static(cloth, Hierarchy((torch.tensor([[0, 1]]),), level), ("mesh", "coarse0"))
    layers = torch.tensor([[0, count - 1], [1, count - 2]])
    graph = build_graph(static, step, contact.nearest, radius=10.0, layers=layers)
    inputs = Inputs(cloth, state, step, contact, graph, pos + some(3, 1e-3), residual=some(3, 10.0))
    return replace(inputs, wide_residual=some(6, 10.0), local_step=some(3, 1e-3), global_step=some(3, 1e-3))


def fold(flat: np.ndarray, angle: float) -> np.ndarray:
    """The sheet ``flat`` (V, 3), y = 0, turned up by ``angle`` [rad] beyond its middle column."""
    columns = np.unique(flat[:, 0])
    middle = columns[len(columns) // 2]
    beyond = np.maximum(flat[:, 0] - middle, 0)
    folded = flat.copy()
    folded[:, 0] = np.minimum(flat[:, 0], middle) + beyond * np.cos(angle)
    folded[:, 1] = beyond * np.sin(angle)
    return folded


def _gradient_states(rng: np.random.Generator) -> tuple[Cloth, dict[str, np.ndarray]]:
    mesh = _wavy_sheet()
    cloth = build_cloth(*mesh, Material(bending_stiffness=1e-2), dtype=torch.float64)
    flat = mesh[0] * np.array([1.0, 0.0, 1.0])
    noise = 1e-3 * rng.normal(size=flat.shape)
    states = {
        "random": mesh[0] + 0.05 * rng.normal(size=flat.shape),
        "flat": flat,
        "folded": fold(flat, 3.0) + 0.1 * noise,
        "stretched": mesh[0] * 3.0 + noise,
        "compressed": mesh[0] * np.array([0.3, 1.0, 0.5]) + noise,
    }
    return cloth, states


def _difference_figure(term: Term, rng: np.random.Generator) -> float:
    """Slope along random directions against central differences of fourth order."""
    cloth, states = _gradient_states(rng)
    worst = 0.0
    for state in states.values():
        pos = torch.as_tensor(state)
        _, gradient = _energy_and_gradient(term, cloth, pos)
        direction = torch.as_tensor(rng.uniform(-1.0, 1.0, size=state.shape))
        h = 1e-5
        near, far = (
            _energy(term, cloth, pos + k * h * direction) - _energy(term, cloth, pos - k * h * direction) for k in (1, 2)
        )
        slope = float((8.0 * near - far) / (12.0 * h))
        size = float(gradient.abs().max().clamp_min(1e-6))  # [N]: a flat sheet may be at rest
        worst = max(worst, abs(slope - float((gradient * direction).sum())) / size)
    return worst


def _rigid_figures(term: Term, cloth: Cloth, state: np.ndarray, rng: np.random.Generator) -> dict[str, float]:
    energy, gradient = _energy_and_gradient(term, cloth, state)
    turn = torch.as_tensor(random_rotation(rng))
    moved = torch.as_tensor(state) @ turn.T + torch.as_tensor(rng.normal(size=3))
    moved_energy, moved_gradient = _energy_and_gradient(term, cloth, moved)
    # A gradient carries the rounding of positions, magnified by one over the size of an element.
    return {
        "rigid_energy": _relative(moved_energy, energy),
        "rigid_gradient": _relative(moved_gradient, gradient @ turn.T),
    }


def _balance_figures(term: Term, cloth: Cloth, state: np.ndarray) -> dict[str, float]:
    _, gradient = _energy_and_gradient(term, cloth, state)
    force = float(gradient.abs().sum())
    assert force > 0, "a crumpled sheet feels no force"
    torque = torch.linalg.cross(torch.as_tensor(state), gradient).sum(dim=0)
    return {
        "net_force": float(gradient.sum(dim=0).abs().max()) / force,
        "net_torque": float(torque.abs().max()) / force,
    }


def _label_figure(term: Term, mesh: Mesh, state: np.ndarray, rng: np.random.Generator) -> float:
    """Change of the energy by flipping every seventh face, and by another order of vertices and faces."""
    pos, faces = mesh
    reference = _energy(term, build_cloth(pos, faces, Material(), dtype=torch.float64), torch.as_tensor(state))
    order = rng.permutation(len(pos))
    worst = 0.0
    for new_pos, new_faces, new_state in (
        (pos, _flip(faces), state),
        (pos[order], rng.permutation(np.argsort(order)[faces], axis=0), state[order]),
    ):
        cloth = build_cloth(new_pos, new_faces, Material(), dtype=torch.float64)
        worst = max(worst, _relative(_energy(term, cloth, torch.as_tensor(new_state)), reference))
    return worst


def _flipped_figure(term: Term) -> float:
    pos, faces = grid(8, 8)
    cloth = build_cloth(pos, _flip(faces), Material(), dtype=torch.float64)
    return float(_energy(term, cloth, cloth.rest_pos))


def _batch_figures(term: Term, rng: np.random.Generator) -> dict[str, float]:
    meshes = [_wavy_sheet(), cylinder(5, 3), strip(3)]
    cloths = [build_cloth(*mesh, Material(), dtype=torch.float64) for mesh in meshes]
    states = [mesh[0] + 0.02 * rng.normal(size=mesh[0].shape) for mesh in meshes]
    together, gradient = _energy_and_gradient(term, concatenate_cloths(cloths), np.concatenate(states))
    alone = [_energy_and_gradient(term, cloth, state) for cloth, state in zip(cloths, states, strict=True)]
    parts = gradient.split([len(state) for state in states])
    return {
        "batch_energy": max(_relative(a, b) for a, (b, _) in zip(together.unsqueeze(1), alone, strict=True)),
        "batch_gradient": max(_relative(a, b) for a, (_, b) in zip(parts, alone, strict=True)),
    }


def _relative(value: Tensor, reference: Tensor) -> float:
    return float((value - reference).abs().max() / reference.abs().max())


def _flip(faces: np.ndarray) -> np.ndarray:
    flipped = faces.copy()
    flipped[::7] = flipped[::7, ::-1]
    return flipped


def _energy(term: Term, cloth: Cloth, pos: Tensor) -> Tensor:
    return term(make_problem(cloth), pos, torch.zeros_like(pos))


def _energy_and_gradient(term: Term, cloth: Cloth, state: np.ndarray | Tensor) -> tuple[Tensor, Tensor]:
    gradient, energies = Potential({"term": term}).gradient(make_problem(cloth), torch.as_tensor(state).to(cloth.rest_pos))
    return energies["term"], gradient


def _wavy_sheet() -> Mesh:
    pos, faces = grid(5, 4, 0.3)
    pos[:, 1] = 0.03 * np.sin(15.0 * pos[:, 0]) * np.cos(8.0 * pos[:, 2])
    return pos, faces
