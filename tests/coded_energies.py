"""The published code's energies, written down once more from what is known of it, vertex by vertex and face by face."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from hood.assets.material import Material
from hood.energies.problem import StepProblem

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
    material: Material = field(default_factory=Material)
    found: dict[int, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)  # see nearest()


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


def collision(case: Case, x: Tensor, lagged: bool, weight: float = WEIGHT) -> Tensor:
    """Cubic, against the plane of the face with the nearest centroid: found at t, at t + 1; lagged, found at t - 1, at t."""
    found = 0 if lagged else 1
    centroid, normal = planes(case, found + 1, nearest(case, found)[0])
    return weight * ((EPSILON - ((x - centroid) * normal).sum(dim=1)).clamp_min(0.0) ** 3).sum()


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
    share = torch.repeat_interleave(case.material.density * face_areas(case) / 3, 3)
    return torch.zeros(len(case.rest)).double().index_add(0, torch.as_tensor(case.faces).reshape(-1), share)


def stretching(case: Case, x: Tensor, lame_lambda: float | None = None) -> Tensor:
    """A h (μ tr G² + ½ λ tr² G), the rest shape laid flat face by face."""
    material = case.material
    a, b, c = corners(case, torch.as_tensor(case.rest))
    along = (b - a) / (b - a).norm(dim=1, keepdim=True)
    across = torch.linalg.cross(torch.linalg.cross(b - a, c - a), along)
    across = across / across.norm(dim=1, keepdim=True)
    flat = torch.stack([torch.stack([((p - a) * axis).sum(1) for axis in (along, across)], dim=1) for p in (b, c)], dim=2)
    a, b, c = corners(case, x)
    deform = torch.stack([b - a, c - a], dim=2) @ torch.linalg.inv(flat)
    strain = 0.5 * (deform.transpose(1, 2) @ deform - torch.eye(2).double())
    bulk = material.lame_lambda if lame_lambda is None else lame_lambda
    trace = strain.diagonal(dim1=1, dim2=2).sum(dim=1)
    density = material.lame_mu * (strain @ strain).diagonal(dim1=1, dim2=2).sum(1) + 0.5 * bulk * trace**2
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
    stiffness = case.material.bending_stiffness * (edge**2).sum(dim=1) / (4 * (areas[left] + areas[right]))
    return (0.5 * stiffness * angle**2).sum()


def inertia(case: Case, x: Tensor) -> Tensor:
    state, dt = case.problem.state, float(case.problem.step.dt)
    away = x - state.pos - dt * state.vel
    return (masses(case)[:, None] * away**2).sum() / 2 / dt**2


def gravity(case: Case, x: Tensor) -> Tensor:
    return G * (masses(case) * x[:, 1]).sum()


TRANSCRIPTION: dict[str, Callable[[Case, Tensor], Tensor]] = {
    "stretching": stretching,
    "bending": bending,
    "inertia": inertia,
    "gravity": gravity,
    "friction": friction,
}
