"""Waves on a surface: the eigenvectors of its Laplacian, from long ones to short ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import eigsh

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
