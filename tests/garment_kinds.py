"""Garment files that are not one tidy sheet: panels, shells, buttons, several garments, encodings; all of embedded garments.

Every kind of :data:`KINDS` is written into a folder by :meth:`Kind.write`; it knows the words that hood says of it, and the
cloth that it shows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from imitations import GltfWriter

from hood.assets.body.load import load_body
from hood.assets.garment.garment import load_garment
from hood.mesh import topology
from hood.mesh.editing.repair import flipped_faces

Mesh = tuple[np.ndarray, np.ndarray]  # (V, 3) m, (F, 3)


@cache
def clean(name: str = "tank") -> Mesh:
    """An embedded garment as the default body wears it in its T-pose."""
    garment = load_garment(name)
    return garment.tpose(np.zeros(10)), garment.faces


def avatar() -> Mesh:
    body = load_body()
    return body.v_template, body.faces


def normals(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) unit normals, faces by their areas."""
    corners = pos[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(pos)
    np.add.at(total, faces.reshape(-1), np.repeat(across, 3, axis=0))
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(pos) for pos, _ in meshes[:-1])])
    faces = [faces + start for (_, faces), start in zip(meshes, starts, strict=True)]
    return np.concatenate([pos for pos, _ in meshes]), np.concatenate(faces)


def part(mesh: Mesh, kept: np.ndarray) -> Mesh:
    """The faces ``kept`` (F,) with vertices of their own."""
    pos, faces = mesh
    used, corners = np.unique(faces[kept], return_inverse=True)
    return pos[used], corners.reshape(-1, 3)


# ---- what is done to a mesh ---------------------------------------------------------------------------------------------


def quarters(mesh: Mesh, gap: float) -> list[Mesh]:
    """Four panels, front and back, left and right, moved apart so that their rims are ``gap`` [m] from each other."""
    pos, faces = mesh
    centre = pos[faces].mean(axis=1)
    middle = pos.mean(axis=0)
    panels = []
    for front in (True, False):
        for left in (True, False):
            kept = ((centre[:, 2] > middle[2]) == front) & ((centre[:, 0] > middle[0]) == left)
            own, table = part(mesh, kept)
            shift = 0.5 * gap * np.array([1.0 if left else -1.0, 0.0, 1.0 if front else -1.0])
            panels.append((own + shift, table))
    return panels


def halves(mesh: Mesh, gap: float) -> list[Mesh]:
    """Front and back, ``gap`` [m] from each other."""
    pos, faces = mesh
    ahead = pos[faces].mean(axis=1)[:, 2] > pos[:, 2].mean()
    shift = np.array([0.0, 0.0, 0.5 * gap])
    return [(part(mesh, ahead)[0] + shift, part(mesh, ahead)[1]), (part(mesh, ~ahead)[0] - shift, part(mesh, ~ahead)[1])]


def refined(mesh: Mesh) -> Mesh:
    """Every face cut into four: rims of another spacing."""
    pos, faces = mesh
    edges = topology.unique_edges(faces)
    a, b, c = faces.T
    ab, bc, ca = (len(pos) + topology.edge_index(edges, np.stack(pair, axis=1)) for pair in ((a, b), (b, c), (c, a)))
    table = [np.stack(face, axis=1) for face in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.concatenate([pos, pos[edges].mean(axis=1)]), np.concatenate(table)


def shell(mesh: Mesh, thickness: float, rims: bool = True, share: float = 0.0) -> Mesh:
    """A closed surface of two layers: the given one, and one ``thickness`` [m] inside of it; ``share`` of it is outside."""
    pos, faces = mesh
    normal = normals(pos, faces)
    outer, inner = pos + share * thickness * normal, pos - (1.0 - share) * thickness * normal
    count = len(pos)
    tables = [faces, faces[:, ::-1] + count]
    if rims:
        half = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        key = np.sort(half, axis=1) @ [count, 1]
        number, back, times = np.unique(key, return_inverse=True, return_counts=True)
        del number
        a, b = half[times[back] == 1].T
        tables += [np.stack([b, a, a + count], axis=1), np.stack([b, a + count, b + count], axis=1)]
    return np.concatenate([outer, inner]), np.concatenate(tables)


def bevelled(mesh: Mesh, thickness: float) -> Mesh:
    """A closed shell whose rims are not upright but drawn out to an edge half way between the layers."""
    pos, faces = mesh
    normal, count = normals(pos, faces), len(pos)
    half = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, back, times = np.unique(np.sort(half, axis=1) @ [count, 1], return_inverse=True, return_counts=True)
    a, b = half[times[back] == 1].T
    rim = np.unique([a, b])
    around, number = np.zeros_like(pos), np.zeros(count)
    for start, end in (half.T, half[:, ::-1].T):
        np.add.at(around, start, pos[end])
        np.add.at(number, start, 1)
    out = pos[rim] - around[rim] / number[rim, None]
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    own = np.full(count, -1)
    own[rim] = 2 * count + np.arange(len(rim))
    tables = [faces, faces[:, ::-1] + count]
    tables += [np.stack(face, axis=1) for face in ((b, a, own[a]), (b, own[a], own[b]))]
    tables += [np.stack(face, axis=1) for face in ((own[b], own[a], a + count), (own[b], a + count, b + count))]
    edge = pos[rim] + 0.5 * thickness * (out - normal[rim])
    return np.concatenate([pos, pos - thickness * normal, edge]), np.concatenate(tables)


def folded_hem(mesh: Mesh, height: float = 0.05, off: float = 3e-3) -> Mesh:
    """The lowest rim goes on outside and up again, as a cuff that is folded."""
    pos, faces = mesh
    normal, rows = normals(pos, faces), 3
    hem = min(topology.boundary_loops(faces), key=lambda loop: float(pos[loop, 1].mean()))
    rings = [hem]
    added = []
    for row in range(1, rows + 1):
        rings.append(len(pos) + (row - 1) * len(hem) + np.arange(len(hem)))
        added.append(pos[hem] + 2 * off * normal[hem] + [0.0, row * height / rows, 0.0])
    tables = []
    for low, high in zip(rings, rings[1:], strict=False):
        after, above = np.roll(low, -1), np.roll(high, -1)
        tables += [np.stack([low, after, above], axis=1), np.stack([low, above, high], axis=1)]
    table = np.concatenate([faces, *tables])
    turned = flipped_faces(table)
    table[turned] = table[turned][:, ::-1]
    return np.concatenate([pos, *added]), table


def belt(mesh: Mesh, height: float = 0.15, thick: float = 4e-3) -> Mesh:
    """A closed cord around the waist."""
    pos, _ = mesh
    near = pos[np.abs(pos[:, 1] - height) < 0.02]
    middle = near.mean(axis=0)
    turns, radii = np.arctan2(*(near - middle)[:, [2, 0]].T), np.hypot(*(near - middle)[:, [0, 2]].T)
    i, j = np.meshgrid(np.arange(48), np.arange(6), indexing="ij")
    turn, around = 2 * np.pi * i / 48, 2 * np.pi * j / 6
    out = (
        np.interp(turn, turns[np.argsort(turns)], radii[np.argsort(turns)], period=2 * np.pi)
        + 1.5 * thick
        + thick * np.cos(around)
    )
    ring = np.stack([middle[0] + out * np.cos(turn), height + thick * np.sin(around), middle[2] + out * np.sin(turn)], axis=2)
    return ring.reshape(-1, 3), _torus_faces(48, 6)


def _torus_faces(first: int, second: int) -> np.ndarray:
    i, j = np.meshgrid(np.arange(first), np.arange(second), indexing="ij")
    a, b, c, d = (((i + k) % first) * second + (j + m) % second for k, m in ((0, 0), (1, 0), (1, 1), (0, 1)))
    return np.concatenate([np.stack(face, axis=2).reshape(-1, 3) for face in ((a, b, c), (a, c, d))])


def doubled(mesh: Mesh, turned: bool = True) -> Mesh:
    """Every face twice, the second time with vertices of its own."""
    pos, faces = mesh
    return joined(mesh, (pos.copy(), faces[:, ::-1] if turned else faces))


def button(middle: np.ndarray, normal: np.ndarray, radius: float = 0.008, height: float = 0.003, sides: int = 12) -> Mesh:
    """A closed disc on the cloth at ``middle`` (3,) [m], half a millimetre off it along ``normal`` (3,)."""
    normal = normal / np.linalg.norm(normal)
    first = np.cross(normal, [0.3, 0.9, 0.2])
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    turn = 2 * np.pi * np.arange(sides) / sides
    ring = radius * (np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second) + middle + 5e-4 * normal
    pos = np.concatenate([ring, ring + height * normal, [ring.mean(axis=0), ring.mean(axis=0) + height * normal]])
    here, after, low, high = np.arange(sides), (np.arange(sides) + 1) % sides, 2 * sides, 2 * sides + 1
    table = [
        (here, after, after + sides), (here, after + sides, here + sides),
        (after, here, np.full(sides, low)), (here + sides, after + sides, np.full(sides, high)),
    ]  # fmt: skip
    return pos, np.concatenate([np.stack(face, axis=1) for face in table])


def eyelet(middle: np.ndarray, normal: np.ndarray, radius: float = 0.006, thick: float = 0.0015, sides: int = 12) -> Mesh:
    """A closed ring (torus) on the cloth."""
    normal = normal / np.linalg.norm(normal)
    first = np.cross(normal, [0.3, 0.9, 0.2])
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    u, v = np.meshgrid(2 * np.pi * np.arange(sides) / sides, 2 * np.pi * np.arange(6) / 6, indexing="ij")
    around = np.cos(u)[..., None] * first + np.sin(u)[..., None] * second
    pos = middle + 2 * thick * normal + (radius + thick * np.cos(v))[..., None] * around + thick * np.sin(v)[..., None] * normal
    return pos.reshape(-1, 3), _torus_faces(sides, 6)


def front_places(mesh: Mesh, count: int = 4) -> list[tuple[np.ndarray, np.ndarray]]:
    """Places and normals down the middle of the front."""
    pos, faces = mesh
    normal = normals(pos, faces)
    ahead = (pos[:, 2] > pos[:, 2].mean()) & (np.abs(pos[:, 0] - pos[:, 0].mean()) < 0.04)
    rows = np.flatnonzero(ahead)
    heights = np.linspace(pos[rows, 1].min(), pos[rows, 1].max(), count + 2)[1:-1]
    chosen = [rows[np.argmin(np.abs(pos[rows, 1] - height))] for height in heights]
    return [(pos[row], normal[row] if normal[row, 2] > 0 else -normal[row]) for row in chosen]


def patch(mesh: Mesh, size: float = 0.09, off: float = 2e-3) -> Mesh:
    """A pocket: a sheet of its own on the cloth, ``off`` [m] over it."""
    pos, faces = mesh
    normal = normals(pos, faces)
    middle = front_places(mesh, 3)[1][0]
    kept = np.linalg.norm(pos[faces].mean(axis=1) - middle, axis=1) < size / 2
    own, table = part((pos + off * normal, faces), kept)
    return own, table


def lining(mesh: Mesh, depth: float, below: float) -> Mesh:
    """A real layer: ``depth`` [m] inside the part of the garment that is over the height ``below`` (share of its own)."""
    pos, faces = mesh
    inner = pos - depth * normals(pos, faces)
    limit = pos[:, 1].min() + below * np.ptp(pos[:, 1])
    return part((inner, faces), pos[faces].mean(axis=1)[:, 1] > limit)


def sewn_lining(mesh: Mesh, depth: float = 3e-3, below: float = 0.6) -> Mesh:
    """A lining whose rim is sewn to the garment: edges of three faces, folded at the top."""
    pos, faces = mesh
    normal = normals(pos, faces)
    limit = pos[:, 1].min() + below * np.ptp(pos[:, 1])
    kept = pos[faces].mean(axis=1)[:, 1] > limit
    used = np.unique(faces[kept])
    half = np.sort(faces[kept][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, times = np.unique(half, axis=0, return_counts=True)
    rim = np.unique(edges[times == 1])
    own = np.setdiff1d(used, rim)
    number = np.arange(len(pos))
    number[own] = len(pos) + np.arange(len(own))
    inner = number[faces[kept]]
    return np.concatenate([pos, pos[own] - depth * normal[own]]), np.concatenate(
        [faces, inner[(inner >= len(pos)).any(axis=1)]]
    )


def cape() -> Mesh:
    """A sheet on the shoulders and the back."""
    pos, faces = clean("dress")
    centre = pos[faces].mean(axis=1)
    kept = (centre[:, 2] < -0.01) & (centre[:, 1] > pos[:, 1].min() + 0.3)
    return part((pos + 0.02 * normals(pos, faces), faces), kept)


# ---- files --------------------------------------------------------------------------------------------------------------


def obj_text(objects: Sequence[tuple[str, Mesh]], word: str = "o") -> str:
    """Objects, groups or materials (``word`` o, g, usemtl) of an OBJ file; an empty name writes none."""
    lines, start = [], 1
    for name, (pos, faces) in objects:
        lines += [f"{word} {name}"] * bool(name)
        lines += [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in pos.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (faces + start).tolist()]
        start += len(pos)
    return "\n".join(lines) + "\n"


def write_objects(path: Path, objects: Sequence[tuple[str, Mesh]], word: str = "o", encoding: str = "utf-8") -> Path:
    path.write_bytes(obj_text(objects, word).encode(encoding))
    return path


def write_mesh(path: Path, mesh: Mesh) -> Path:
    return write_objects(path, [("", mesh)])


def ply_text(mesh: Mesh) -> str:
    pos, faces = mesh
    head = ["ply", "format ascii 1.0", f"element vertex {len(pos)}", *(f"property double {axis}" for axis in "xyz")]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    rows = [f"{x:.9f} {y:.9f} {z:.9f}" for x, y, z in pos.tolist()] + [f"3 {a} {b} {c}" for a, b, c in faces.tolist()]
    return "\n".join([*head, *rows]) + "\n"


def off_text(mesh: Mesh) -> str:
    pos, faces = mesh
    rows = [f"{x:.9f} {y:.9f} {z:.9f}" for x, y, z in pos.tolist()] + [f"3 {a} {b} {c}" for a, b, c in faces.tolist()]
    return "\n".join(["OFF", f"{len(pos)} {len(faces)} 0", *rows]) + "\n"


def stl_text(mesh: Mesh) -> str:
    pos, faces = mesh
    rows = ["solid tank"]
    for corners in pos[faces]:
        rows += ["facet normal 0 0 1", "outer loop", *(f"vertex {x:.9f} {y:.9f} {z:.9f}" for x, y, z in corners.tolist())]
        rows += ["endloop", "endfacet"]
    return "\n".join([*rows, "endsolid"]) + "\n"


def write_glb(path: Path, objects: Sequence[tuple[str, Mesh]]) -> Path:
    """A glTF scene with one node a mesh."""
    writer = GltfWriter()
    meshes, nodes = [], []
    for name, (pos, faces) in objects:
        attributes = {"POSITION": writer.table(pos.astype(np.float32))}
        indices = writer.table(faces.astype(np.uint32).reshape(-1))
        meshes.append({"primitives": [{"attributes": attributes, "indices": indices}]})
        nodes.append({"mesh": len(meshes) - 1, "name": name})
    writer.document |= {"meshes": meshes, "nodes": nodes}
    return writer.write(path)


# ---- the kinds ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Kind:
    """A kind of file."""

    write: Callable[[Path], Path]  # into a folder
    says: str  # words of the one sentence about it; "": nothing is said
    shows: Callable[[], Mesh] | None = None  # the cloth, where it is the same as in a clean file
    riders: int = 0  # groups of what rides on it
    pieces: int = 1  # garments
    thickness: float = 0.0  # m
    tolerance: float = 1e-6  # m, of the positions


def _obj(name: str, mesh: Callable[[], Mesh], scale: float = 1.0) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        pos, faces = mesh()
        return write_mesh(folder / f"{name}.obj", (scale * pos, faces))

    return write


def _objects(name: str, word: str, *objects: tuple[str, Callable[[], Mesh]]) -> Callable[[Path], Path]:
    return lambda folder: write_objects(folder / f"{name}.obj", [(own, mesh()) for own, mesh in objects], word)


def _glb(name: str, *objects: tuple[str, Callable[[], Mesh]]) -> Callable[[Path], Path]:
    return lambda folder: write_glb(folder / f"{name}.glb", [(own, mesh()) for own, mesh in objects])


def _stitched(gap: float) -> Callable[[Path], Path]:
    """Front and back, joined by lines between the vertices that belong together, as sewing threads of modelling programs."""

    def write(folder: Path) -> Path:
        (front, faces), (back, table) = halves(clean("tank"), gap)
        half = lambda own: own[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)  # noqa: E731
        rims = []
        for own in (faces, table):
            edges, times = np.unique(np.sort(half(own), axis=1), axis=0, return_counts=True)
            rims.append(np.unique(edges[times == 1]))
        shift = np.array([0.0, 0.0, gap])
        dist = np.linalg.norm(front[rims[0]][:, None] - shift - back[rims[1]][None], axis=2)
        pairs = [(rims[0][k], rims[1][n]) for k, n in enumerate(dist.argmin(axis=1)) if dist[k, n] < 1e-9]
        text = obj_text([("", joined((front, faces), (back, table)))])
        lines = [f"l {a + 1} {b + 1 + len(front)}" for a, b in pairs]
        (folder / f"stitched{gap}.obj").write_text(text + "\n".join(lines) + "\n")
        return folder / f"stitched{gap}.obj"

    return write


def _text(name: str, make: Callable[[Mesh], str], encoding: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / name).write_bytes(make(clean("tank")).encode(encoding))
        return folder / name

    return write


def _tank() -> Mesh:
    return clean("tank")


def _skirt() -> Mesh:
    return clean("skirt")


def _with(things: Callable[[Mesh], list[Mesh]]) -> Callable[[], Mesh]:
    return lambda: joined(clean("tank"), *things(clean("tank")))


def _buttons(mesh: Mesh) -> list[Mesh]:
    return [button(*place) for place in front_places(mesh)]


def _eyelets(mesh: Mesh) -> list[Mesh]:
    return [eyelet(*place) for place in front_places(mesh)]


def _buckle(mesh: Mesh) -> list[Mesh]:
    """A frame and its pin, which touch."""
    middle, normal = front_places(mesh, 3)[1]
    return [eyelet(middle, normal, radius=0.02, thick=0.002), button(middle + 0.002 * normal, normal, 0.019, 0.002)]


def _teeth(mesh: Mesh) -> list[Mesh]:
    """Discs that touch each other, in a row of 20 cm."""
    pos, faces = mesh
    middle, normal = front_places(mesh, 3)[1]
    places = [middle + [0.0, shift, 0.0] for shift in np.linspace(-0.1, 0.1, 40)]
    front = pos[pos[:, 2] > pos[:, 2].mean()]
    depth = [front[np.argmin(np.linalg.norm(front[:, :2] - place[:2], axis=1)), 2] for place in places]
    return [button(np.array([*place[:2], z + 2e-3]), normal, 2.6e-3, 2e-3) for place, z in zip(places, depth, strict=True)]


def _far_bead(mesh: Mesh) -> list[Mesh]:
    return [button(np.array([0.0, 0.3, 0.9]), np.array([0.0, 0.0, 1.0]))]


def _thick_quarters() -> Mesh:
    return joined(*(shell(panel, 1e-3) for panel in quarters(clean("tank"), 2e-3)))


def _uneven_halves() -> Mesh:
    front, back = halves(clean("tank"), 2e-3)
    return joined(refined(front), back)


def _dense_lining() -> Mesh:
    pos, faces = clean("tank")
    return joined((pos, faces), refined((pos - 3e-3 * normals(pos, faces), faces)))


def _torn_strips() -> Mesh:
    """A shell whose rim strips have vertices of their own."""
    pos, faces = shell(clean("tank"), 2e-3)
    count = 2 * len(clean("tank")[1])
    return joined(part((pos, faces), np.arange(len(faces)) < count), part((pos, faces), np.arange(len(faces)) >= count))


KINDS: dict[str, Kind] = {
    "panels touching": Kind(_obj("panels0", lambda: joined(*quarters(_tank(), 0.0))), "vertices on seams"),
    **{
        f"panels {1e3 * gap:g} mm apart": Kind(
            _obj(f"panels{k}", lambda gap=gap: joined(*quarters(_tank(), gap))), "rims of 4 pieces lie along each other"
        )
        for k, gap in enumerate((5e-4, 1.5e-3, 3e-3, 5e-3), start=1)
    },
    "panels in centimetres": Kind(
        _obj("panels_cm", lambda: joined(*quarters(_tank(), 3e-3)), 100.0), "rims of 4 pieces lie along each other"
    ),
    "front and back": Kind(_obj("halves", lambda: joined(*halves(_tank(), 4e-3))), "rims of 2 pieces lie along each other"),
    "stitched panels": Kind(_stitched(0.016), "pairs of vertices that the file stitches"),
    "stitches that are open": Kind(_stitched(0.1), "stitches are longer than 20 mm", pieces=2),
    "panels of other edges": Kind(_obj("uneven", _uneven_halves), "rims of 2 pieces lie along each other"),
    **{
        f"shell of {1e3 * thick:g} mm": Kind(
            _obj(f"shell{k}", lambda thick=thick: shell(_tank(), thick)), "cloth with its thickness", _tank, thickness=thick
        )
        for k, thick in enumerate((5e-4, 2e-3, 5e-3))
    },
    "shell around the cloth": Kind(
        _obj("shell_middle", lambda: shell(_tank(), 2e-3, share=0.5)), "cloth with its thickness", thickness=2e-3
    ),
    "shell of an open jacket": Kind(
        _obj("shell_jacket", lambda: shell(clean("jacket"), 5e-3)), "cloth with its thickness", lambda: clean("jacket"),
        thickness=5e-3,
    ),
    "shell without rims": Kind(
        _obj("shell_open", lambda: shell(_tank(), 2e-3, rims=False)), "cloth with its thickness", _tank, thickness=2e-3
    ),
    "shell with torn rims": Kind(_obj("shell_torn", _torn_strips), "cloth with its thickness", _tank, thickness=2e-3),
    "shell of a folded hem": Kind(
        _obj("fold", lambda: shell(folded_hem(_skirt(), off=4e-3), 1e-3)), "cloth with its thickness",
        lambda: folded_hem(_skirt(), off=4e-3), thickness=1e-3, tolerance=2e-3,
    ),
    "shell with bevelled rims": Kind(
        _obj("bevel", lambda: bevelled(_tank(), 3e-3)), "cloth with its thickness", _tank, thickness=3e-3
    ),
    "shells of panels": Kind(_obj("shell_panels", _thick_quarters), "cloth with its thickness", thickness=1e-3),
    "doubled faces": Kind(_obj("doubled", lambda: doubled(_tank())), "lie on others", _tank),
    "doubled faces, same winding": Kind(_obj("doubled_same", lambda: doubled(_tank(), False)), "lie on others", _tank),
    "doubled faces in glTF": Kind(_glb("doubled", ("tank", lambda: doubled(_tank()))), "duplicate faces", _tank),
    "buttons": Kind(_obj("buttons", _with(_buttons)), "4 closed parts on the cloth", _tank, riders=4),
    "eyelets": Kind(_obj("eyelets", _with(_eyelets)), "4 closed parts on the cloth", _tank, riders=4),
    "a buckle of two parts": Kind(_obj("buckle", _with(_buckle)), "2 closed parts on the cloth", _tank, riders=1),
    "buttons in millimetres": Kind(_obj("buttons_mm", _with(_buttons), 1000.0), "4 closed parts on the cloth", riders=4),
    "teeth of a zipper": Kind(_obj("zipper", _with(_teeth)), "40 closed parts on the cloth", _tank, riders=40),
    "a belt": Kind(_obj("belt", _with(lambda mesh: [belt(mesh)])), "1 long closed part on the cloth", _tank, riders=-1),
    "a bead beside it": Kind(_obj("bead", _with(_far_bead)), "on no cloth", _tank),
    "a pocket": Kind(_obj("pocket", _with(lambda mesh: [patch(mesh)])), "1 sheet on the cloth", _tank, riders=-1),
    "two garments": Kind(
        _obj("two", lambda: joined(_tank(), _skirt())), "2 garments, part_1", lambda: joined(_tank(), _skirt()), pieces=2
    ),
    **{
        f"two garments by {word}": Kind(
            _objects(f"two_{word}", word, ("tank", _tank), ("skirt", _skirt)),
            "2 garments, tank (1016 vertices), skirt (994 vertices)",
            lambda: joined(_tank(), _skirt()),
            pieces=2,
        )
        for word in ("o", "g", "usemtl")
    },
    "two garments in glTF": Kind(
        _glb("two", ("tank", _tank), ("skirt", _skirt)), "2 garments, tank", lambda: joined(_tank(), _skirt()), pieces=2
    ),
    "an avatar beside it": Kind(
        _objects("avatar", "o", ("Avatar", avatar), ("tank", _tank)), "a body beside the garment, 'Avatar'", _tank
    ),
    "an avatar without names": Kind(
        _obj("unnamed", lambda: joined(avatar(), _tank())), "a body beside the garment, 'part_1'", _tank
    ),
    "an avatar in glTF": Kind(
        _glb("avatar", ("tank", _tank), ("Avatar", avatar)), "a body beside the garment, 'Avatar'", _tank
    ),
    "a lining of a part": Kind(
        _obj("lining", lambda: joined(_tank(), lining(_tank(), 3e-3, 0.5))), "2 garments",
        lambda: joined(_tank(), lining(_tank(), 3e-3, 0.5)), pieces=2,
    ),
    "a whole lining of another mesh": Kind(_obj("dense", _dense_lining), "2 garments", _dense_lining, pieces=2),
    "a folded hem": Kind(_obj("folded", lambda: folded_hem(_skirt())), "", lambda: folded_hem(_skirt())),
    "an avatar in centimetres": Kind(
        lambda folder: write_objects(
            folder / "cm.obj", [(name, (100.0 * mesh[0], mesh[1])) for name, mesh in (("Avatar", avatar()), ("tank", _tank()))]
        ),
        "a body beside the garment, 'Avatar'",
    ),
    "a lining sewn in": Kind(_obj("sewn", lambda: sewn_lining(_tank())), "", lambda: sewn_lining(_tank())),
    "a cape": Kind(_obj("cape", cape), "", cape),
    "a byte-order mark": Kind(_text("mark.obj", lambda mesh: obj_text([("", mesh)]), "utf-8-sig"), "", _tank),
    "UTF-16": Kind(_text("wide.obj", lambda mesh: obj_text([("", mesh)]), "utf-16"), "", _tank),
    "Latin-1 names": Kind(_text("latin.obj", lambda mesh: obj_text([("Kleid_für_Jörg", mesh)]), "latin-1"), "", _tank),
    "a marked PLY": Kind(_text("mark.ply", ply_text, "utf-8-sig"), "", _tank),
    "a marked OFF": Kind(_text("mark.off", off_text, "utf-8-sig"), "", _tank),
    "a marked STL": Kind(_text("mark.stl", stl_text, "utf-8-sig"), "", _tank),
}  # fmt: skip
