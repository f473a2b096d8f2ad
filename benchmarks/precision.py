"""Where a naive formula loses its digits, and what the package computes in its place.

    python benchmarks/precision.py

Prints one row per case: what a textbook form gives, what the package gives, and the limit where there is one. References
are computed in float64. The exit status is 1 when a limit is violated.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from hood.assets.material import Material
from hood.cloth.cloth import Cloth, build_cloth
from hood.cloth.state import Obstacle, State
from hood.contact.contact import find_contact
from hood.energies.bending import Bending
from hood.energies.contact import Collision
from hood.energies.laws import mollified_norm
from hood.energies.mass_points import Inertia
from hood.energies.membrane import Stretching
from hood.energies.potential import Potential
from hood.mesh.geometry import dihedral_angles, face_normals, vertex_normals
from hood.scene.scene import recentre
from hood.testing import Mesh, cylinder, grid, make_problem, plane_contact, sphere

G = 9.81
FLOAT, DOUBLE = torch.float32, torch.float64
PLACES = (1.0, 100.0, 1e3, 1e4)  # m from the world's origin


@dataclass(frozen=True)
class Row:
    """A line of the table; ``met`` is None where there is no limit."""

    case: str
    naive: str
    safe: str
    limit: str = ""
    met: bool | None = None


def hinge(angle: float, size: float, dtype: torch.dtype) -> Tensor:
    """Four vertices, edge along x, folded by ``angle``."""
    wing = [0.3, np.sin(angle), np.cos(angle)]
    return torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.4, 0, -1], wing], dtype=DOUBLE).mul(size).to(dtype)


HINGE = torch.tensor([[0, 1, 2, 3]])


def hinge_normals(pos: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    edge, a, b = (pos[i] - pos[0] for i in (1, 2, 3))
    return edge, torch.linalg.cross(edge, a), torch.linalg.cross(b, edge)


def angle_by_acos(pos: Tensor) -> Tensor:
    _, n1, n2 = hinge_normals(pos)
    return torch.acos((n1 / n1.norm()).dot(n2 / n2.norm()).clamp(-1.0, 1.0))


def angle_by_unit_edge(pos: Tensor) -> Tensor:
    edge, n1, n2 = hinge_normals(pos)
    n1, n2 = n1 / n1.norm(), n2 / n2.norm()
    return torch.atan2(torch.linalg.cross(n1, n2).dot(edge / edge.norm()), n1.dot(n2))


def angle_unscaled(pos: Tensor) -> Tensor:
    edge, n1, n2 = hinge_normals(pos)
    return torch.atan2(torch.linalg.cross(n1, n2).dot(edge), edge.norm() * n1.dot(n2))


def safe_angle(pos: Tensor) -> Tensor:
    return dihedral_angles(pos, HINGE)[0]


def value_and_slope(function: Callable[[Tensor], Tensor], at: Tensor) -> tuple[float, Tensor]:
    point = at.clone().requires_grad_(True)
    value = function(point)
    (slope,) = torch.autograd.grad(value, point)
    return float(value.detach()), slope


def both(function: Callable[[Tensor], Tensor], at: Tensor) -> str:
    value, slope = value_and_slope(function, at)
    return f"θ {value:.1e}, gradient {'finite' if bool(torch.isfinite(slope).all()) else 'NaN'}"


def finite(function: Callable[[Tensor], Tensor], at: Tensor) -> bool:
    value, slope = value_and_slope(function, at)
    return bool(np.isfinite(value)) and bool(torch.isfinite(slope).all())


def hinges() -> Iterator[Row]:
    flat = hinge(0.0, 1.0, FLOAT)
    yield Row("flat hinge, acos", both(angle_by_acos, flat), both(safe_angle, flat), "finite", finite(safe_angle, flat))
    bent = hinge(1e-3, 1.0, FLOAT)
    exact = value_and_slope(safe_angle, bent.double())[0]
    errors = [abs(abs(value_and_slope(f, bent)[0]) / abs(exact) - 1) for f in (angle_by_acos, safe_angle)]
    yield Row("θ = 1e-3, acos, float32", f"{errors[0]:.1e}", f"{errors[1]:.1e}", "1e-4 relative", errors[1] <= 1e-4)
    closed = hinge(0.5, 1.0, FLOAT)
    closed[1] = closed[0]
    naive, safe = both(angle_by_unit_edge, closed), both(safe_angle, closed)
    yield Row("zero-length edge, e/‖e‖", naive, safe, "finite", finite(safe_angle, closed))
    small = hinge(0.5, 1e-4, FLOAT)
    slope, exact_slope = value_and_slope(safe_angle, small)[1].double(), value_and_slope(safe_angle, small.double())[1]
    error = float((slope - exact_slope).norm() / exact_slope.norm())
    result = f"gradient off by {error:.0e}"
    yield Row("0.1 mm edges, products of L¹⁰, float32", both(angle_unscaled, small), result, "1e-5 relative", error <= 1e-5)


def flipped_faces() -> Row:
    pos, faces = grid(8, 8, 0.3)
    faces[::7] = faces[::7, ::-1]
    cloth = build_cloth(pos, faces, Material(), dtype=DOUBLE)
    normal = face_normals(cloth.rest_pos, cloth.faces)
    pairs = face_pairs(faces)
    cosine = (normal[pairs[:, 0]] * normal[pairs[:, 1]]).sum(1).clamp(-1, 1)
    weight = cloth.bending_stiffness.mean() * cloth.hinge_rest_length.mean() ** 2 / (4 * cloth.hinge_area.mean())
    naive = float(0.5 * weight * torch.acos(cosine).square().sum())
    safe = float(Bending()(make_problem(cloth), cloth.rest_pos, cloth.rest_pos))
    return Row("1/7 of the faces flipped, flat sheet: energy", f"{naive:.1e} J", f"{safe:.1e} J", "0", safe == 0.0)


def face_pairs(faces: np.ndarray) -> Tensor:
    """Pairs (H, 2) of faces with a common edge."""
    owner: dict[tuple[int, int], list[int]] = {}
    for index, face in enumerate(faces.tolist()):
        for k in range(3):
            a, b = sorted((face[k], face[(k + 1) % 3]))
            owner.setdefault((a, b), []).append(index)
    return torch.tensor([pair for pair in owner.values() if len(pair) == 2])


def norms() -> Iterator[Row]:
    zero = torch.zeros(3)
    naive = value_and_slope(lambda x: (x * x).sum().sqrt(), zero)[1]
    safe = value_and_slope(lambda x: mollified_norm((x * x).sum(), torch.tensor(1e-4)), zero)[1]
    ok = bool((safe == 0).all())
    yield Row("‖slip‖ at 0: gradient", f"{float(naive[0])}", f"{float(safe.abs().max())}", "0", ok)
    flat = torch.zeros(3, 3)
    flat[1, 0] = 1e-8  # a face without area
    face = torch.tensor([[0, 1, 2]])
    naive = value_and_slope(lambda cross: functional.normalize(cross, dim=0).sum(), zero)[1]
    safe = value_and_slope(lambda pos: face_normals(pos, face).sum(), flat)[1]
    size = float(safe.abs().max())
    yield Row("normal of a face without area: gradient", f"{float(naive.abs().max()):.0e}", f"{size}", "0", size == 0.0)


def half_precision() -> Iterator[Row]:
    depth = torch.tensor(2e-3, dtype=torch.float16)
    cloth = build_cloth(*grid(3, 3, 0.1), Material(), dtype=DOUBLE)
    for dtype in (torch.float16, torch.bfloat16):
        problem = make_problem(cloth, contact=plane_contact(cloth.rest_pos))
        try:
            Potential({"collision": Collision()}).total(problem, cloth.rest_pos.to(dtype))
            refused = False
        except ValueError:
            refused = True
        if dtype == torch.float16:
            naive = f"{float(depth**3):.0e} m³ instead of 8e-9"
        else:
            naive = f"positions at 1.7 m off by up to {1e3 * 0.5 * float(torch.finfo(dtype).eps):.1f} mm"
        name = str(dtype).removeprefix("torch.")
        yield Row(f"contact energy, {name}", naive, "refused" if refused else "computed", "refused", refused)


def inertia() -> Iterator[Row]:
    """Error of the acceleration that the inertia term sees, for a cloth in motion: 1.5 m/s, about 1 g, at 1/240 s."""
    rng, dt = np.random.default_rng(0), 1 / 240
    pos, faces = grid(20, 20, 0.2)
    acc = torch.as_tensor(G * rng.normal(size=pos.shape) / np.sqrt(3))
    vel = torch.as_tensor(rng.normal(size=pos.shape) + [1.5, 0.0, 0.0])
    for place in PLACES:
        now = torch.as_tensor(pos + [place + 0.1371, 1.2345, 0.3777])
        before, after = now - dt * vel, now + dt * vel + dt * dt * acc
        naive = (after.float() - 2 * now.float() + before.float()) / dt**2
        state, cloth = local_state(now, faces), build_cloth(pos, faces, Material())
        state = replace(state, vel=vel.float())
        problem = make_problem(cloth, state.pos, state.vel, dt)
        given = acc.float()
        next_pos = state.pos + dt * state.vel + dt * dt * given
        gradients = [Potential({"inertia": Inertia()}).gradient(problem, next_pos, a)[0] for a in (given, None)]
        fed, derived = (rms(gradient.double() / cloth.mass.double()[:, None] - acc) / G for gradient in gradients)
        off = rms(naive.double() - acc) / G
        limit = ("1e-6 g", fed <= 1e-6) if place == PLACES[-1] else ("", None)
        safe = f"{fed:.0e} g fed ({derived:.0e} g from local positions)"
        yield Row(f"inertia, float32, 1/240 s, {place:g} m away", f"{off:.0e} g", safe, *limit)


def rms(error: Tensor) -> float:
    return float(error.square().sum(1).mean().sqrt())


def local_state(world: Tensor, faces: np.ndarray) -> State:
    """Float32 state of float64 world positions (V, 3), in the frame that a rollout keeps next to the cloth."""
    origin = world.mean(dim=0).round()
    state = State((world - origin).float(), torch.zeros(len(world), 3), origin.unsqueeze(0))
    return recentre(state, torch.zeros(len(world), dtype=torch.int64))


def membrane_force(cloth: Cloth, pos: Tensor) -> Tensor:
    return Potential({"stretching": Stretching()}).gradient(make_problem(cloth), pos)[0].double()


def membrane() -> Iterator[Row]:
    """Error of the membrane force, relative to a vertex's weight, for a wavy sheet of 20 × 20 cells."""
    for edge, places in ((1e-2, PLACES), (1e-3, (1e4,)), (1e-1, (1e4,))):
        pos, faces = grid(21, 21, 20 * edge)
        shape = pos + np.stack([0 * pos[:, 0], edge * np.sin(pos[:, 0] / edge / 2), 0 * pos[:, 0]], axis=1)
        single, double = (build_cloth(pos, faces, Material(), dtype=dtype) for dtype in (FLOAT, DOUBLE))
        weight = G * float(double.mass.median())
        for place in places:
            world = torch.as_tensor(shape + [place + 0.1371, 1.2345, 0.3777])
            exact = membrane_force(double, world - world.mean(dim=0))
            naive = rms(membrane_force(single, world.float()) - exact) / weight
            state = local_state(world, faces)
            found = membrane_force(single, state.pos)
            # What a rollout's file holds, origin + pos in float64, is the state; its force is the reference.
            written = state.origin[0] + state.pos.double()
            safe = rms(found - membrane_force(double, written - state.origin[0])) / weight
            stored = rms(found - exact) / weight
            limit = 1e-3 if edge >= 1e-2 else 1e-2
            text = f"{safe:.1e} ({stored:.1e} with the rounding of stored positions)"
            case = f"membrane, float32, {100 * edge:g} cm edges, {place:g} m away"
            checked = place == PLACES[-1]
            yield Row(case, f"{naive:.1e}", text, f"{limit:.0e} weights" if checked else "", safe <= limit if checked else None)


def limb(radius: float = 0.035, around: int = 14, length: float = 0.4) -> Mesh:
    """A forearm: triangles of about 1.5 cm, vertices shifted at random along the surface."""
    rng = np.random.default_rng(0)
    rows = int(length / (2 * np.pi * radius / around)) + 1
    pos, faces = cylinder(around, rows, radius, length)
    turn = rng.uniform(-0.3, 0.3, len(pos)) * 2 * np.pi / around
    x, z = pos[:, 0], pos[:, 2]
    pos = np.stack([np.cos(turn) * x - np.sin(turn) * z, pos[:, 1], np.sin(turn) * x + np.cos(turn) * z], axis=1)
    pos[:, 1] += rng.uniform(-0.3, 0.3, len(pos)) * length / (rows - 1)
    return pos, faces


def at_rest(mesh: Mesh, shift: Tensor | None = None) -> Obstacle:
    pos, faces = torch.as_tensor(mesh[0]), torch.as_tensor(mesh[1])
    after = pos if shift is None else pos + shift
    return Obstacle(pos, after, pos, faces, torch.zeros(len(pos)).long(), torch.zeros(len(faces)).long())


def signed_distance() -> Row:
    rng, radius, gap = np.random.default_rng(1), 0.035, 5e-3
    body = at_rest(limb(radius))
    angle, height = rng.uniform(0, 2 * np.pi, 4000), rng.uniform(0.1, 0.3, 4000)
    ring = (radius + gap) * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    pos = torch.as_tensor(ring + height[:, None] * np.array([0.0, 1.0, 0.0]))
    contact = find_contact(pos, torch.zeros(len(pos)).long(), body)
    normal = vertex_normals(body.pos, body.faces)[contact.vertex]
    side = ((pos - body.pos[contact.vertex]) * normal).sum(1)
    naive = torch.where(side < 0, -1.0, 1.0) * contact.vertex_dist
    texts, errors = [], []
    for dist in (naive, contact.dist):
        errors.append(float((dist - gap).square().mean().sqrt()))
        texts.append(f"RMSE {1e3 * errors[-1]:.2f} mm, {100 * float((dist < 0).double().mean()):.0f}% wrong signs")
    return Row("5 mm off a limb of 3.5 cm: nearest vertex / triangle", *texts, "1 mm", errors[1] <= 1e-3)


def correspondence() -> Iterator[Row]:
    """Cloth 1 mm ahead of a limb of radius 5 cm that sets off at a given speed; the frame is 1/30 s."""
    rng, radius, dt = np.random.default_rng(2), 0.05, 1 / 30
    heading = torch.tensor([1.0, 0.0, 0.0], dtype=DOUBLE)
    ray = rng.normal(size=(4000, 3))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    pos = torch.as_tensor((radius + 1e-3) * ray[ray[:, 0] > 0.5])
    scene = torch.zeros(len(pos)).long()
    for speed in (0.5, 1.5, 3.6, 6.0):
        shift = speed * dt * heading
        moved = at_rest((sphere(3, radius)[0] + shift.numpy(), sphere(3, radius)[1]))
        shares = []
        for contact in (find_contact(pos, scene, moved), find_contact(pos, scene, at_rest(sphere(3, radius), shift))):
            hit = contact.next_dist(pos) < Collision().epsilon
            # A match at t + 1 knows no more than where the vertex is then: outside means no contact.
            hit &= contact.valid
            forward = contact.next_normal @ heading > 0
            shares.append((float((hit & forward).double().mean()), float((hit & ~forward).double().mean())))
        text = [f"{100 * ahead:.0f}% forward, {100 * back:.0f}% backward" for ahead, back in shares]
        limit = ("100% forward", shares[1][0] == 1.0)
        yield Row(f"found at t + 1 / at t, body at {speed:g} m/s: pushed", *text, *limit)


def table() -> list[Row]:
    rows = [*hinges(), flipped_faces(), *norms(), *half_precision(), *inertia(), *membrane(), signed_distance()]
    return [*rows, *correspondence()]


def main() -> int:
    rows = table()
    print("| case | naive | here | limit | |\n|---|---|---|---|---|")
    for row in rows:
        verdict = {None: "", True: "met", False: "VIOLATED"}[row.met]
        print(f"| {row.case} | {row.naive} | {row.safe} | {row.limit} | {verdict} |")
    return int(any(row.met is False for row in rows))


if __name__ == "__main__":
    sys.exit(main())
