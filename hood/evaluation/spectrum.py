"""Where the error of a step lives: its share in waves of every length on the garment.

A method's positions x and the minimum x* of the same step that a minimisation from x ends in differ by d = x − x*. In the
modes of the rest shape's Laplacian d falls into bands of wavelengths, octaves from the size of the garment down to two of its
edges: few local sweeps polish what is short and hardly touch what is long.

Waves on a surface: the eigenvectors of its Laplacian, from long ones to short ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy import linalg, sparse
from scipy.sparse.linalg import eigsh
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.energies.potential import Potential, scale
from hood.energies.problem import StepProblem
from hood.evaluation.gap import REFERENCE
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system.iterate import in_double

#: Up to as many vertices every mode is computed, beyond them only the longest :data:`NUM_LONGEST`.
DENSE_VERTICES = 1600
NUM_LONGEST = 256


@dataclass(frozen=True)
class Modes:
    """Eigenvectors φ of L φ = k² A φ, orthonormal in the area-weighted product φᵀ A φ, by falling wavelength.

    On a plane they are sine waves of wave number k; a component's constant has k = 0. Vertices of no face are in no mode.
    """

    vertices: np.ndarray  # (N,) indices of the vertices with an area
    area: np.ndarray  # (N,) m², a third of the faces around a vertex
    vectors: np.ndarray  # (N, K) 1/m
    wavelengths: np.ndarray  # (K,) m, falling; infinite for constants
    complete: bool  # K = N: they span all there is

    def project(self, values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """The part of ``values`` (V, C) in the modes ``chosen`` (K,) bool; 0 at vertices of no face."""
        basis = self.vectors[:, chosen]
        part = np.zeros_like(values)
        part[self.vertices] = basis @ (basis.T @ (self.area[:, None] * values[self.vertices]))
        return part

    def mean_square(self, values: np.ndarray) -> float:
        """Mean of |values|² over the area, for values (V, C); that of orthogonal parts adds up."""
        squares = (values[self.vertices] ** 2).sum(axis=1)
        return float(self.area @ squares / self.area.sum())


def surface_modes(pos: np.ndarray, faces: np.ndarray) -> Modes:
    """Modes of the surface of triangles ``faces`` (F, 3) between ``pos`` (V, 3) [m], by cotangent weights and lumped areas.

    Raises:
        ValueError: a face has no area.
    """
    stiffness, area = cotangent_laplacian(np.asarray(pos, dtype=np.float64), faces)
    vertices = np.flatnonzero(area > 0)
    stiffness, area = stiffness[vertices][:, vertices], area[vertices]
    complete = len(vertices) <= DENSE_VERTICES
    # Scaled to an ordinary eigenproblem, S = A^-1/2 L A^-1/2.
    root = 1.0 / np.sqrt(area)
    scaled = sparse.diags(root) @ stiffness @ sparse.diags(root)
    if complete:
        squares, vectors = linalg.eigh(scaled.toarray())
    else:
        start = np.random.default_rng(0).normal(size=len(vertices))
        shift = -1e-3 * 4.0 * np.pi**2 / area.sum()  # just below the constants, where the matrix has its inverse
        squares, vectors = eigsh(scaled.tocsc(), NUM_LONGEST, sigma=shift, which="LM", v0=start)
        order = np.argsort(squares)
        squares, vectors = squares[order], vectors[:, order]
    # Rounding leaves constants a tiny square of either sign.
    squares = np.where(squares > 1e-9 * 4.0 * np.pi**2 / area.sum(), squares, 0.0)
    with np.errstate(divide="ignore"):
        wavelengths = 2.0 * np.pi / np.sqrt(squares)
    return Modes(vertices, area, root[:, None] * vectors, wavelengths, complete)


def cotangent_laplacian(pos: np.ndarray, faces: np.ndarray) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Stiffness (V, V) of linear elements, positive semi-definite, and lumped areas (V,) [m²].

    Raises:
        ValueError: a face has no area.
    """
    num_vertices, rows, columns, values = len(pos), [], [], []
    double_area = np.linalg.norm(np.cross(pos[faces[:, 1]] - pos[faces[:, 0]], pos[faces[:, 2]] - pos[faces[:, 0]]), axis=1)
    if len(faces) and not double_area.min() > 0:
        raise ValueError(f"face {int(double_area.argmin())} has no area: its Laplacian has no meaning; repair the mesh")
    for corner in range(3):
        at, first, second = faces[:, corner], faces[:, (corner + 1) % 3], faces[:, (corner + 2) % 3]
        half = 0.5 * ((pos[first] - pos[at]) * (pos[second] - pos[at])).sum(axis=1) / double_area
        rows += [first, second, first, second]
        columns += [second, first, first, second]
        values += [-half, -half, half, half]
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    area = np.bincount(faces.reshape(-1), np.repeat(double_area / 6.0, 3), minlength=num_vertices)
    return sparse.csr_matrix(entries, shape=(num_vertices, num_vertices)), area


SPECTRUM_COLUMNS = ("model", "garment", "longest", "shortest", "rms", "share", "energy", "states", "unconverged")


@dataclass(frozen=True)
class Bands:
    """Bands of wavelengths of a garment, from long to short; what its modes do not resolve is in the last."""

    modes: Modes
    limits: tuple[float, ...]  # (n,) m, falling, between the n + 1 bands

    def split(self, values: np.ndarray) -> list[np.ndarray]:
        """The parts of ``values`` (V, C) in the bands, orthogonal over the area; their sum is ``values``."""
        waves, parts, above = self.modes.wavelengths, [], np.inf
        for limit in self.limits:
            parts.append(self.modes.project(values, (waves >= limit) & ((waves < above) | np.isinf(above))))
            above = limit
        return [*parts, values - sum(parts, start=np.zeros_like(values))]


def garment_bands(cloth: Cloth) -> Bands:
    """Octaves from the diagonal of the rest shape's box to two mean edges, as far down as the modes reach."""
    pos = cloth.rest_pos.detach().cpu().double().numpy()
    start, end = cloth.edges.cpu().numpy().T
    edge = float(np.linalg.norm(pos[end] - pos[start], axis=1).mean())
    modes = surface_modes(pos, cloth.faces.cpu().numpy())
    shortest = 2.0 * edge if modes.complete else max(2.0 * edge, float(modes.wavelengths[-1]))
    limits, limit = [], float(np.linalg.norm(pos.max(axis=0) - pos.min(axis=0)))
    while limit >= shortest:
        limits.append(limit)
        limit *= 0.5
    return Bands(modes, tuple(limits))


@torch.no_grad()
def error_spectrum(
    potential: Potential, problem: StepProblem, next_pos: Tensor, bands: Bands, settings: NewtonSettings = REFERENCE
) -> dict[str, Any]:
    """Spectrum of the error of ``next_pos`` (V, 3) in the step ``problem``, as plain numbers, one per band in the lists.

    ``limits`` [m] of the bands, ``rms`` [m] of the error over the garment's area, in squares they add up to the whole;
    ``energy`` [e0], what the potential rises by when that band's error alone is added to the minimum (not a share of γ: the
    bands act on each other); ``converged`` of the minimisation (0 or 1). Computed in float64.
    """
    work = in_double(potential.prepare(problem))
    pos = next_pos.detach().double()
    minimum, report = minimize(potential, work, pos, settings)
    parts = bands.split((pos - minimum).cpu().numpy())
    lowest, e0 = potential.total(work, minimum), scale(work)
    added = [potential.total(work, minimum + torch.as_tensor(part).to(minimum)) - lowest for part in parts]
    return {
        "limits": list(bands.limits),
        "rms": [bands.modes.mean_square(part) ** 0.5 for part in parts],
        "energy": [float(value / e0) for value in added],
        "converged": float(report.converged.all()),
    }


def spectrum_rows(model: str, garment: str, spectra: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row per band, medians over states: ``rms`` [mm], its ``share`` of the mean square, ``energy`` [e0], between the
    wavelengths ``longest`` and ``shortest`` [m] (None: without end)."""
    if not spectra:
        return []
    limits = spectra[0]["limits"]
    rms = np.array([item["rms"] for item in spectra])
    total = (rms**2).sum(axis=1, keepdims=True)
    share = np.divide(rms**2, total, out=np.zeros_like(rms), where=total > 0)
    energy = np.array([item["energy"] for item in spectra])
    missed = float(np.mean([item["converged"] == 0.0 for item in spectra]))
    return [
        {
            "model": model,
            "garment": garment,
            "longest": longest,
            "shortest": shortest,
            "rms": float(1e3 * np.median(rms[:, band])),
            "share": float(np.median(share[:, band])),
            "energy": float(np.median(energy[:, band])),
            "states": len(spectra),
            "unconverged": missed,
        }
        for band, (longest, shortest) in enumerate(zip([None, *limits], [*limits, None], strict=True))
    ]


def format_spectrum(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as text, one line per band."""
    lines = [
        "error against the minimum by wavelength: RMS [mm] (share of the mean square; e0 it costs alone), medians over states"
    ]
    for model, garment in dict.fromkeys((row["model"], row["garment"]) for row in rows):
        part = [row for row in rows if (row["model"], row["garment"]) == (model, garment)]
        lines.append(f"{model} {garment}, {part[0]['states']} states:")
        lines += [f"  {band_name(row):>18}  {row['rms']:8.3f}  ({row['share']:4.0%}; {row['energy']:.2g})" for row in part]
    return "\n".join(lines)


def band_name(row: Mapping[str, Any]) -> str:
    """The band's wavelengths in words [cm]."""
    if row["longest"] is None:
        return f"above {100 * row['shortest']:.3g} cm" if row["shortest"] is not None else "all"
    if row["shortest"] is None:
        return f"below {100 * row['longest']:.3g} cm"
    return f"{100 * row['shortest']:.3g} to {100 * row['longest']:.3g} cm"


def bar_panels(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """RMS error [mm] by garment, band and model: what a bar chart of the rows shows."""
    panels: dict[str, dict[str, dict[str, float]]] = {}
    for row in rows:
        panel = panels.setdefault(f"{row['garment']}: RMS error [mm] by wavelength", {})
        panel.setdefault(band_name(row), {})[row["model"]] = row["rms"]
    return panels
