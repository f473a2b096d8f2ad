"""The static cloth of a scene: topology, rest shape and fabric of one or several garments, as flat tensors.

Warp of a garment's faces: where the threads run that go along a piece of the pattern.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hood.assets.material import WEAVE, Material
from hood.cloth.fabric import FabricMap
from hood.mesh import geometry, topology
from hood.mesh.editing.quality import check_triangles
from hood.mesh.flat import Construction, edge_extents, edge_lengths, laid_out, rest_angles, rest_of
from hood.tensors.batch import concatenate, indexes
from hood.tensors.dense import add_rows

#: A face within this sine of the horizontal has its warp along z: the vertical does not tell one there.
_LEVEL = 0.1
#: Texture triangles whose edges have a smaller sine between them have no directions.
_FLAT = 1e-6
#: Lengths of one edge within this share are equal.
_EVEN = 1e-5


def grain_of(pos: np.ndarray, faces: np.ndarray, uv: tuple[np.ndarray, np.ndarray] | None = None) -> np.ndarray:
    """Warp of every face as shares of its edges x₁ - x₀ and x₂ - x₀, (F, 2): a direction in the cloth, however it is shaped.

    The warp runs along v of the texture coordinates, the weft across it in the face, about along u. Where there are none it
    runs along the vertical at rest, and along z on faces that are horizontal.

    Args:
        pos: (V, 3) m at rest, y up.
        faces: (F, 3).
        uv: texture coordinates (U, 2) and which the corners of every face have, (F, 3).
    """
    edges = pos[faces[:, 1:]] - pos[faces[:, :1]]  # (F, edge, axis)
    metric = np.einsum("fix,fjx->fij", edges, edges)
    normal = np.cross(edges[:, 0], edges[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    level = np.hypot(normal[:, 0], normal[:, 2]) < _LEVEL
    axis = np.where(level[:, None], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0])
    grain = np.linalg.solve(metric, np.einsum("fix,fx->fi", edges, axis)[..., None])[..., 0]
    if uv is not None:
        table = uv[0][uv[1][:, 1:]] - uv[0][uv[1][:, :1]]
        area = table[:, 0, 0] * table[:, 1, 1] - table[:, 0, 1] * table[:, 1, 0]
        laid = np.abs(area) > _FLAT * np.linalg.norm(table, axis=2).prod(axis=1)
        along = np.stack([-table[:, 1, 0], table[:, 0, 0]], axis=1) / np.where(laid, area, 1.0)[:, None]
        grain = np.where(laid[:, None], along, grain)
    # Of the length of a typical edge: what textures count in is no matter.
    return grain / np.sqrt(np.einsum("fi,fij,fj->f", grain, metric, grain) / np.einsum("fii->f", metric))[:, None]


def along_grain(rest_inverse: Tensor, grain: Tensor) -> Tensor:
    """Inverse rest edge matrices (F, 2, 2) [1/m] in frames whose first axis is the warp (F, 2); as given where that is zero."""
    ((a, b), (c, d)) = (row.unbind(dim=1) for row in rest_inverse.unbind(dim=1))
    first, second = grain.unbind(dim=1)
    x, y = d * first - b * second, a * second - c * first  # the warp in the frame as it is, times the determinant
    length = torch.hypot(x, y)
    scale = torch.where(length > 0, length, 1.0)
    cos, sin = torch.where(length > 0, x / scale, 1.0), y / scale
    return torch.stack([a * cos + b * sin, b * cos - a * sin, c * cos + d * sin, d * cos - c * sin], dim=1).reshape(-1, 2, 2)


#: Faces longer than this many times their height are warned about: their elements are stiff and lose digits.
_ASPECT_LIMIT = 1e3


@dataclass(frozen=True)
class Cloth:
    """B garments, concatenated. Derived fields (masses, rest quantities) are constant during a rollout.

    Fabric fields live where the energies need them (faces, hinges); ``vertex_fabric`` and ``edge_fabric`` hold
    (lame_mu [Pa], lame_lambda [Pa], bending_stiffness [J]) where the network's features need them. How a property given
    elsewhere gets there: :mod:`hood.cloth.fabric`.
    """

    rest_pos: Tensor  # (V, 3) m
    faces: Tensor = indexes("vertices")  # (F, 3)
    edges: Tensor = indexes("vertices")  # (E, 2) unique, undirected
    hinges: Tensor = indexes("vertices")  # (H, 4) edge start, edge end, opposite vertex of each face
    vertex_scene: Tensor = indexes("scenes")  # (V,)
    edge_scene: Tensor = indexes("scenes")  # (E,)
    face_scene: Tensor = indexes("scenes")  # (F,)
    hinge_scene: Tensor = indexes("scenes")  # (H,)
    pinned: Tensor = None  # type: ignore[assignment]  # (V,) bool
    # fabric
    density: Tensor = None  # type: ignore[assignment]  # (F,) kg/m²
    thickness: Tensor = None  # type: ignore[assignment]  # (F,) m
    lame_mu: Tensor = None  # type: ignore[assignment]  # (F,) Pa
    lame_lambda: Tensor = None  # type: ignore[assignment]  # (F,) Pa
    bending_stiffness: Tensor = None  # type: ignore[assignment]  # (H,) J
    friction: Tensor = None  # type: ignore[assignment]  # (V,) factor on the coefficient of friction on the body
    vertex_fabric: Tensor = None  # type: ignore[assignment]  # (V, 3)
    edge_fabric: Tensor = None  # type: ignore[assignment]  # (E, 3)
    # derived from the rest shape
    mass: Tensor = None  # type: ignore[assignment]  # (V,) kg
    rest_area: Tensor = None  # type: ignore[assignment]  # (F,) m²
    rest_inverse: Tensor = None  # type: ignore[assignment]  # (F, 2, 2) 1/m, inverse rest edges; along warp and weft if woven
    hinge_rest_length: Tensor = None  # type: ignore[assignment]  # (H,) m, hinge edge at rest
    hinge_area: Tensor = None  # type: ignore[assignment]  # (H,) m², sum of the two faces at rest
    rest_angle: Tensor = None  # type: ignore[assignment]  # (H,) rad
    # None where the fabric is the same in all directions
    weave: Tensor | None = None  # (F, 3) factors on its stiffness along the warp, along the weft and in shear
    grain: Tensor | None = None  # (F, 2) warp as shares of the edges x₁ - x₀ and x₂ - x₀; zero where it plays no role
    flat: Tensor | None = None  # (F, 2, 2) m, those edges in the flat pattern (:mod:`hood.mesh.flat`); None: as in rest_pos
    num_scenes: int = 1  # B

    @property
    def num_vertices(self) -> int:
        """V, of all garments together."""
        return self.rest_pos.shape[0]

    @cached_property
    def free(self) -> Tensor:
        """Vertices that the simulation moves, (V,) bool: neither pinned nor isolated (massless)."""
        return ~self.pinned & (self.mass > 0)

    @cached_property
    def has_pinned(self) -> bool:
        """Whether a vertex is pinned; waits for the device once."""
        return bool(self.pinned.any())

    @cached_property
    def scene_sizes(self) -> tuple[int, ...]:
        """Vertices of every scene, known to the host; waits for the device once, and only where there are several scenes."""
        if self.num_scenes == 1:
            return (self.num_vertices,)
        return tuple(torch.bincount(self.vertex_scene, minlength=self.num_scenes).tolist())

    @cached_property
    def edge_length_sq(self) -> Tensor:
        """Mean square [m²] (V,) of the rest lengths of the edges at every vertex; 0 at isolated ones."""
        start, end = self.edges.unbind(dim=1)
        ends = torch.stack([self.rest_edge_sq, torch.ones_like(self.rest_edge_sq)], dim=1)
        total = add_rows(add_rows(ends.new_zeros(self.num_vertices, 2), start, ends), end, ends)
        return total[:, 0] / total[:, 1].clamp_min(1.0)

    @cached_property
    def rest_edge_sq(self) -> Tensor:
        """Squares [m²] (E,) of the rest lengths of the edges."""
        return self.edge_sq(self.rest_pos) if self.flat is None else self.rest_length.square()

    @cached_property
    def rest_length(self) -> Tensor:
        """Lengths [m] (E,) of the edges at rest: of a flat pattern those in its faces."""
        if self.flat is not None:
            return edge_lengths(self.flat, self.faces, self.edges)
        start, end = self.edges.unbind(dim=1)
        return (self.rest_pos[end] - self.rest_pos[start]).norm(dim=1)

    @cached_property
    def rest_extents(self) -> tuple[Tensor, Tensor]:
        """The least and the greatest length [m] (E,) that the faces at every edge have there at rest: gathered cloth and what
        it is sewn to."""
        return (self.rest_length,) * 2 if self.flat is None else edge_extents(self.flat, self.faces, self.edges)

    @cached_property
    def gathered_edges(self) -> Tensor:
        """Rows (N,) of the edges whose faces disagree by more than rounding about their length at rest."""
        least, most = self.rest_extents
        return (most > (1.0 + _EVEN) * least).nonzero().squeeze(1)

    def edge_strain(self, pos: Tensor, rows: Tensor | None = None) -> Tensor:
        """Relative length change (N,) of the edges, or those of ``rows`` (N,), at ``pos`` (V, 3) [m], signed: what is beyond
        all lengths of gathered ones."""
        own = slice(None) if rows is None else rows
        start, end = self.edges[own].unbind(dim=1)
        length = (pos[end] - pos[start]).norm(dim=1)
        least, most = (side[own] for side in self.rest_extents)
        return (length / most - 1.0).clamp_min(0.0) + (length / least - 1.0).clamp_max(0.0)

    @cached_property
    def mean_edge(self) -> float:
        """Mean length [m] of the edges at rest; 0 without edges."""
        return float(self.rest_edge_sq.double().sqrt().mean()) if len(self.edges) else 0.0

    @cached_property
    def _ends(self) -> Tensor:
        """The first and the second vertices (2, E) of the edges, without gaps: such are gathered sooner."""
        with torch.inference_mode(False):  # gradients may be asked for later
            return self.edges.t().contiguous()

    def edge_sq(self, pos: Tensor) -> Tensor:
        """Squares [m²] (E,) of the lengths of the edges at ``pos`` (V, 3) [m]."""
        start, end = self._ends.unbind()
        square = (pos.index_select(0, end) - pos.index_select(0, start)).square()
        return square[:, 0] + square[:, 1] + square[:, 2]  # sooner than a sum over rows of three, and the same bits

    def largest_of_edges(self, values: Tensor) -> Tensor:
        """The largest of ``values`` (E,) >= 0 among the edges at every vertex, (V,); 0 at isolated ones."""
        ends, twice = self._ends.view(-1), torch.cat([values, values])
        return values.new_zeros(self.num_vertices).scatter_reduce(0, ends, twice, "amax")


def build_cloth(
    rest_pos: np.ndarray,
    faces: np.ndarray,
    material: Material,
    pinned: np.ndarray | None = None,
    flat_rest: bool = False,
    stiffness: np.ndarray | None = None,
    dtype: torch.dtype = torch.float32,
    uv: tuple[np.ndarray, np.ndarray] | None = None,
    flat: np.ndarray | None = None,
    made: Construction | None = None,
) -> Cloth:
    """Cloth of one garment.

    Legal, and handled so: an isolated vertex has no mass and stays where it is. An edge with three or more faces has a
    hinge between each of them and the next, in the order of their indices. Winding plays no role in any energy;
    faces may be flipped at will. Components do not act on each other. Faces beyond an aspect ratio of 1000 (longest edge
    over height) are warned about.

    Args:
        rest_pos: (V, 3) [m], the undeformed garment.
        faces: (F, 3) vertex indices.
        material: fabric; each property a number or a field on vertices, faces or edges.
        pinned: (V,) bool, vertices that follow prescribed positions.
        stiffness: (V,) factors on both Lamé parameters, of bindings and seams; faces and edges have the mean of their corners.
        flat_rest: take 0 as rest angle of every hinge instead of the angle in ``rest_pos``.
        uv: texture coordinates (U, 2) and those of every face's corners, (F, 3): along v runs the warp of a fabric that has
            one. None: see :func:`hood.cloth.cloth.grain_of`.
        flat: (F, 3, 2) [m], the corners of every face in the flat pattern, whose lengths, areas and angles are then those at
            rest; of faces of NaN those of ``rest_pos`` are. None: of all. The warp runs along its second axis.
        made: its elastic, folds and layers; ``flat_rest`` leaves folds out.

    Raises:
        ValueError: the mesh cannot be simulated (see :func:`hood.mesh.editing.quality.check_triangles`), a fabric's field or
            ``pinned`` does not fit it; names the index and the fix.
    """
    points, triangles = np.asarray(rest_pos), np.asarray(faces)
    check_triangles(points, triangles, "cloth")
    # Rest quantities are differences of positions: computed in float64, stored in the working precision.
    points, triangles = points.astype(np.float64), triangles.astype(np.int64)
    pos, tri = torch.as_tensor(points), torch.as_tensor(triangles)
    edge_table, hinge_table = topology.unique_edges(triangles), topology.hinges(triangles)
    edges, hinges = torch.as_tensor(edge_table), torch.as_tensor(hinge_table.vertices)
    area = geometry.triangle_areas(pos, tri)
    fabric = FabricMap(material, len(points), triangles, edge_table, area.numpy(), stiffness)
    density = torch.tensor(fabric.on_faces("density"))
    hinge_edges = topology.edge_index(edge_table, hinge_table.vertices[:, :2])
    angle = geometry.dihedral_angles(pos, hinges)
    real = {
        "rest_pos": pos,
        "density": density,
        **{name: torch.tensor(fabric.on_faces(name)) for name in ("thickness", "lame_mu", "lame_lambda")},
        "bending_stiffness": torch.tensor(fabric.on_edges("bending_stiffness")[hinge_edges]),
        "friction": torch.tensor(fabric.on_vertices("friction")),
        "vertex_fabric": torch.tensor(np.stack([fabric.on_vertices(name) for name in _FEATURES], axis=1)),
        "edge_fabric": torch.tensor(np.stack([fabric.on_edges(name) for name in _FEATURES], axis=1)),
        "mass": geometry.vertex_masses(pos, tri, density),
        "rest_area": area,
        "rest_inverse": geometry.rest_inverse(pos, tri),
        "hinge_rest_length": (pos[hinges[:, 1]] - pos[hinges[:, 0]]).norm(dim=1),
        "hinge_area": area[torch.as_tensor(hinge_table.faces)].sum(dim=1),
        "rest_angle": torch.zeros_like(angle) if flat_rest else angle,
    }
    made = made or Construction()
    if flat is not None or made.elastic is not None:
        shape = laid_out(pos, tri, flat)
        if made.elastic is not None:
            shape, real["density"] = made.contracted(shape, density)
        real |= rest_of(shape, tri, hinges, real["density"], len(points))
    _warn_about_slivers(pos[tri] if flat is None else torch.as_tensor(flat), real["rest_area"], tri)
    if flat is not None:
        real["rest_angle"] = torch.zeros_like(angle) if flat_rest else rest_angles(pos, hinges, hinge_table.faces, flat)
        uv = (flat.reshape(-1, 2), np.arange(flat[..., 0].size).reshape(-1, 3))
    if made.fold is not None and not flat_rest:
        real["rest_angle"] = made.rest_angles(real["rest_angle"], triangles, *hinge_table)
    if made.bending is not None:
        real["bending_stiffness"] *= torch.as_tensor(made.factors(triangles, *hinge_table))
    weave = np.stack([fabric.on_faces(name) for name in WEAVE], axis=1)
    if made.elastic is not None:  # threads of gathered cloth are not taut: the elastic is
        weave[(made.elastic != 1.0).any(axis=1)] = 1.0
    if (weave != 1.0).any():
        grain = torch.as_tensor(grain_of(points, triangles, uv))
        real |= {"weave": torch.tensor(weave), "grain": grain, "rest_inverse": along_grain(real["rest_inverse"], grain)}
    return Cloth(
        faces=tri,
        edges=edges,
        hinges=hinges,
        vertex_scene=torch.zeros(len(points), dtype=torch.int64),
        edge_scene=torch.zeros(len(edges), dtype=torch.int64),
        face_scene=torch.zeros(len(tri), dtype=torch.int64),
        hinge_scene=torch.zeros(len(hinges), dtype=torch.int64),
        pinned=_pinned_mask(pinned, len(points)),
        num_scenes=1,
        **{name: value.to(dtype) for name, value in real.items()},
    )


def with_values(cloth: Cloth, rest_pos: Tensor | None = None, flat: Tensor | None = None, **fabric: Tensor | float) -> Cloth:
    """The cloth with another fabric or rest shape, as a function of these that autograd follows.

    Args:
        rest_pos: (V, 3) m. Of a cloth with a flat pattern it plays no role in the energies but for the angles.
        flat: (F, 2, 2) m, edges of the faces in the flat pattern, of a cloth that has one.
        fabric: ``density`` [kg/m²], ``lame_mu``, ``lame_lambda`` [Pa], ``thickness`` [m] on faces, ``bending_stiffness`` [J] on
            hinges, ``friction`` on vertices: one number or as many.

    Raises:
        ValueError: a name is none of these, a length does not fit, or the fabric has a warp and the rest shape changes.

    Examples:
        >>> import numpy as np, torch, hood
        >>> faces = np.array([[0, 1, 2]])
        >>> cloth = build_cloth(np.eye(3), faces, hood.Material(), dtype=torch.float64)
        >>> density = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
        >>> with_values(cloth, density=density).mass.sum().backward()
        >>> round(float(density.grad), 4)  # the area
        0.866
    """
    fields = {"bending_stiffness": cloth.hinge_area, "friction": cloth.mass}
    changed: dict[str, Any] = {}
    told: dict[str, Tensor] = {}
    for name, value in fabric.items():
        if name not in ("density", "lame_mu", "lame_lambda", "thickness", *fields):
            raise ValueError(f"cloth: {name!r} is no number of a fabric; give density, lame_mu, lame_lambda, thickness, "
                             "bending_stiffness or friction")  # fmt: skip
        like = fields.get(name, cloth.rest_area)
        given = torch.as_tensor(value, dtype=like.dtype)
        if given.shape not in ((), like.shape):
            raise ValueError(f"cloth: {name} has the shape {tuple(given.shape)}; give one number or {tuple(like.shape)}")
        changed[name], told[name] = given.expand(like.shape), given
    changed |= _features(cloth, told)
    density = changed.get("density", cloth.density)
    if (rest_pos is not None or flat is not None) and cloth.weave is not None:
        raise ValueError("cloth: its fabric has a warp; the rest shape of an isotropic one can be changed")
    if flat is not None and cloth.flat is None:
        raise ValueError("cloth: it has no flat pattern; give rest_pos")
    if cloth.flat is not None:
        shape = cloth.flat if flat is None else flat
        if flat is not None or "density" in changed:
            changed |= rest_of(shape, cloth.faces, cloth.hinges, density, cloth.num_vertices)
    elif rest_pos is not None or "density" in changed:
        pos = cloth.rest_pos if rest_pos is None else rest_pos
        changed["mass"] = geometry.vertex_masses(pos, cloth.faces, density)
    if rest_pos is not None:
        changed |= {"rest_pos": rest_pos, "rest_angle": geometry.dihedral_angles(rest_pos, cloth.hinges)}
        if cloth.flat is None:
            area = geometry.triangle_areas(rest_pos, cloth.faces)
            owners = torch.as_tensor(topology.hinges(cloth.faces.cpu().numpy()).faces, device=area.device)
            changed |= {
                "rest_area": area,
                "rest_inverse": geometry.rest_inverse(rest_pos, cloth.faces),
                "hinge_rest_length": (rest_pos[cloth.hinges[:, 1]] - rest_pos[cloth.hinges[:, 0]]).norm(dim=1),
                "hinge_area": area[owners].sum(dim=1),
            }
    return replace(cloth, **changed)


def concatenate_cloths(cloths: Sequence[Cloth]) -> Cloth:
    """Several cloths as one flat batch; scene *i* of the result is the *i*-th scene of the inputs in order."""
    counts = {"vertices": [c.num_vertices for c in cloths], "scenes": [c.num_scenes for c in cloths]}
    if any(cloth.weave is not None for cloth in cloths):
        cloths = [cloth if cloth.weave is not None else _without_grain(cloth) for cloth in cloths]
    if any(cloth.flat is not None for cloth in cloths):
        cloths = [c if c.flat is not None else replace(c, flat=laid_out(c.rest_pos, c.faces)) for c in cloths]
    return concatenate(cloths, counts)


def _without_grain(cloth: Cloth) -> Cloth:
    """An isotropic cloth as one with a weave: the same energy to rounding."""
    like, count = cloth.rest_area, len(cloth.faces)
    return replace(cloth, weave=like.new_ones(count, 3), grain=like.new_zeros(count, 2))


def _features(cloth: Cloth, told: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """``vertex_fabric`` and ``edge_fabric`` of a cloth with other values, each one number or as many as :func:`with_values`
    takes, by the rules of :mod:`hood.cloth.fabric`. An edge without a hinge bends as its ends do."""
    if not any(name in told for name in _FEATURES):
        return {}
    columns = [list(cloth.vertex_fabric.unbind(dim=1)), list(cloth.edge_fabric.unbind(dim=1))]
    for place, name in enumerate(_FEATURES):
        values = told.get(name)
        if values is None:
            continue
        if values.ndim == 0:
            columns[0][place], columns[1][place] = (values.expand(len(rows[place])) for rows in columns)
            continue
        edges, elements, weight = cloth.edges.cpu().numpy(), cloth.faces, cloth.rest_area.detach()
        if name == "bending_stiffness":
            elements, weight = cloth.hinges[:, :2], torch.ones_like(cloth.hinge_area)
            sides = elements
        else:
            sides = elements[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        of_vertices = _around(elements, values, weight, cloth.num_vertices, values.mean())
        at = torch.as_tensor(topology.edge_index(edges, sides.cpu().numpy()), device=values.device).view(len(values), -1)
        ends = of_vertices[cloth.edges].mean(dim=1)
        columns[0][place] = of_vertices
        columns[1][place] = _around(at, values, torch.ones_like(weight), len(cloth.edges), ends)
    return {"vertex_fabric": torch.stack(columns[0], dim=1), "edge_fabric": torch.stack(columns[1], dim=1)}


def _around(elements: Tensor, values: Tensor, weight: Tensor, count: int, other: Tensor) -> Tensor:
    """Weighted means (count,) of ``values`` (N,) of the elements (N, C) around; ``other`` where there is none."""
    shares = torch.stack([weight * values, weight], dim=1).repeat_interleave(elements.shape[1], dim=0)
    total = add_rows(shares.new_zeros(count, 2), elements.reshape(-1), shares)
    some = total[:, 1] > 0
    return torch.where(some, total[:, 0] / torch.where(some, total[:, 1], 1.0), other)


#: What vertex_fabric and edge_fabric hold, in this order.
_FEATURES = ("lame_mu", "lame_lambda", "bending_stiffness")


def _pinned_mask(pinned: np.ndarray | None, num_vertices: int) -> Tensor:
    if pinned is None:
        return torch.zeros(num_vertices, dtype=torch.bool)
    mask = np.asarray(pinned)
    if mask.shape != (num_vertices,) or not np.isin(mask, (0, 1)).all():
        raise ValueError(
            f"cloth: pinned has shape {mask.shape} and type {mask.dtype}; give one bool per vertex, ({num_vertices},) "
            "(from indices: mask = np.zeros(num_vertices, bool); mask[indices] = True)"
        )
    return torch.as_tensor(mask.astype(bool))


def _warn_about_slivers(corners: Tensor, area: Tensor, faces: Tensor) -> None:
    """Warn of the worst face by its corners (F, 3, 2 or 3) at rest; those of NaN are passed over."""
    longest_sq = (corners - corners[:, [1, 2, 0]]).square().sum(dim=2).amax(dim=1).nan_to_num()
    aspect = 0.5 * longest_sq / area
    worst = int(aspect.argmax())
    if float(aspect[worst]) > _ASPECT_LIMIT:
        warnings.warn(
            f"cloth: face {worst} (vertices {faces[worst].tolist()}) is {float(aspect[worst]):.0e} times longer than high; "
            "such slivers are stiff and lose digits, remesh the garment",
            stacklevel=3,
        )
