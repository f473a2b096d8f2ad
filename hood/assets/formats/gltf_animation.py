"""Animated glTF scenes as moving vertices: node animation, skinning, morph targets (glTF 2.0, sections 3.6 to 3.11).

Where the nodes of an animated glTF scene are at any time: keys, interpolation, hierarchy (glTF 2.0, section 3.11).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.files.guarded import Refused, guarded, listed
from hood.assets.files.library import SIZE_LIMIT
from hood.assets.formats.gltf import Gltf, read_gltf

_MAX_DEPTH = 500


class _Channel(NamedTuple):
    times: np.ndarray  # (K,) s, increasing
    values: np.ndarray  # (K, width), or (K, 3, width) of cubic splines: in-tangent, value, out-tangent
    kind: str

    def at(self, times: np.ndarray, rotation: bool) -> np.ndarray:
        """(T, width) at ``times``; held before the first and after the last key."""
        last = len(self.times) - 1
        index = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, max(last - 1, 0))
        following = np.minimum(index + 1, last)
        span = np.maximum(self.times[following] - self.times[index], 1e-12)
        share = np.clip((times - self.times[index]) / span, 0.0, 1.0)[:, None]
        if self.kind == "CUBICSPLINE":
            value = self._spline(index, following, share, span[:, None])
        elif self.kind == "STEP":
            value = np.where(share >= 1.0, self.values[following], self.values[index])
        elif rotation:
            value = _slerp(self.values[index], self.values[following], share)
        else:
            value = self.values[index] * (1.0 - share) + self.values[following] * share
        return _unit(value) if rotation else value

    def _spline(self, index: np.ndarray, following: np.ndarray, u: np.ndarray, span: np.ndarray) -> np.ndarray:
        square, cube = u * u, u * u * u
        start, leave = self.values[index, 1], self.values[index, 2]
        arrive, end = self.values[following, 0], self.values[following, 1]
        return (
            (2 * cube - 3 * square + 1) * start
            + span * (cube - 2 * square + u) * leave
            + (3 * square - 2 * cube) * end
            + span * (cube - square) * arrive
        )


class Player:
    """Where the nodes of a scene are at given times."""

    def __init__(self, gltf: Gltf, animation: dict[str, Any] | None) -> None:
        self.gltf = gltf
        self.nodes = gltf.items("nodes")
        self.parents = self._find_parents()
        self.channels: dict[tuple[int, str], _Channel] = {}
        for channel in [] if animation is None else animation["channels"]:
            target = channel["target"]
            if target.get("node") is not None and target["path"] in ("translation", "rotation", "scale", "weights"):
                sampler = animation["samplers"][channel["sampler"]] if animation else {}
                self.channels[target["node"], target["path"]] = self._channel(sampler, target)

    def times(self, fps: float) -> np.ndarray:
        """Times [s] of the frames, from the first to the last key; one where nothing is animated."""
        if not self.channels:
            return np.zeros(1)
        first = min(channel.times[0] for channel in self.channels.values())
        last = max(channel.times[-1] for channel in self.channels.values())
        count = np.floor((last - first) * fps + 1e-4) + 1  # keys are float32
        if count > 1e6:
            raise Refused(f"its animation lasts {last - first:g} s; that is more than a million frames")
        return first + np.arange(int(count)) / fps

    def world(self, node: int, times: np.ndarray, worlds: dict[int, np.ndarray]) -> np.ndarray:
        """(T, 4, 4) node to world; ``worlds`` keeps what is known at these times."""
        line = [node]
        while line[-1] not in worlds and line[-1] in self.parents:
            line.append(self.parents[line[-1]])
            if len(line) > _MAX_DEPTH:
                raise Refused("its nodes are nested without end; the file is damaged")
        for index in reversed(line):
            if index not in worlds:
                local = self._local(index, times)
                worlds[index] = worlds[self.parents[index]] @ local if index in self.parents else local
        return worlds[node]

    def joint_matrices(self, skin: dict[str, Any], times: np.ndarray, worlds: dict[int, np.ndarray]) -> np.ndarray:
        """(T, J, 4, 4) from the bind pose to the pose at ``times``."""
        joints = skin["joints"]
        inverse = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
        if "inverseBindMatrices" in skin:
            # Matrices are stored column by column.
            inverse = self.gltf.table(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        if len(inverse) < len(joints):
            raise Refused(f"a skin has {len(joints)} joints and {len(inverse)} bind matrices; the file is damaged")
        for joint in joints:
            self.gltf.item("nodes", joint)
        return np.stack([self.world(joint, times, worlds) @ inverse[row] for row, joint in enumerate(joints)], axis=1)

    def weights(self, node: int, times: np.ndarray, count: int) -> np.ndarray:
        """(T, M) of the ``count`` morph targets of the node's mesh."""
        if (node, "weights") in self.channels:
            return self.channels[node, "weights"].at(times, rotation=False)[:, :count]
        mesh = self.gltf.item("meshes", self.nodes[node]["mesh"])
        rest = self.nodes[node].get("weights", mesh.get("weights", [0.0] * count))
        return np.broadcast_to(np.array(rest, dtype=np.float64), (len(times), count))

    def _local(self, node: int, times: np.ndarray) -> np.ndarray:
        spec = self.nodes[node]
        if "matrix" in spec:
            return np.broadcast_to(np.array(spec["matrix"], dtype=np.float64).reshape(4, 4).T, (len(times), 4, 4))
        parts = {}
        for path, rest in (("translation", [0.0] * 3), ("rotation", [0.0, 0.0, 0.0, 1.0]), ("scale", [1.0] * 3)):
            if (node, path) in self.channels:
                parts[path] = self.channels[node, path].at(times, path == "rotation")
            else:
                value = np.array(spec.get(path, rest), dtype=np.float64).reshape(len(rest))
                parts[path] = np.broadcast_to(_unit(value) if path == "rotation" else value, (len(times), len(rest)))
        result = np.zeros((len(times), 4, 4))
        result[:, :3, :3] = Rotation.from_quat(parts["rotation"]).as_matrix() * parts["scale"][:, None, :]
        result[:, :3, 3] = parts["translation"]
        result[:, 3, 3] = 1.0
        return result

    def _channel(self, sampler: dict[str, Any], target: dict[str, Any]) -> _Channel:
        self.gltf.item("nodes", target["node"])
        times = self.gltf.table(sampler["input"])[:, 0].astype(np.float64)
        values = self.gltf.table(sampler["output"]).astype(np.float64)
        kind = sampler.get("interpolation", "LINEAR")
        if len(times) == 0 or not np.isfinite(times).all() or (np.diff(times) < 0).any() or not np.isfinite(values).all():
            raise Refused(f"the animation of node {target['node']} has no increasing, finite keys; the file is damaged")
        rows = len(times) * (3 if kind == "CUBICSPLINE" else 1)
        width = {"translation": 3, "rotation": 4, "scale": 3}.get(target["path"], values.size // rows)
        if kind not in ("LINEAR", "STEP", "CUBICSPLINE") or values.size != rows * width or width == 0:
            raise Refused(f"the animation of node {target['node']} has {values.size} values for {len(times)} keys")
        shape = (len(times), 3, width) if kind == "CUBICSPLINE" else (len(times), width)
        return _Channel(times, values.reshape(shape), kind)

    def _find_parents(self) -> dict[int, int]:
        parents: dict[int, int] = {}
        for index, node in enumerate(self.nodes):
            for child in node.get("children", []):
                self.gltf.item("nodes", child)
                if child in parents:
                    raise Refused(f"node {child} has two parents; the file is damaged")
                parents[child] = index
        return parents


def _unit(quaternion: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return np.where(length > 1e-12, quaternion / np.maximum(length, 1e-12), [0.0, 0.0, 0.0, 1.0])


def _slerp(start: np.ndarray, end: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Between unit quaternions (T, 4) along the short arc."""
    start, end = _unit(start), _unit(end)
    dot = (start * end).sum(axis=1, keepdims=True)
    end, dot = np.where(dot < 0, -end, end), np.abs(dot)
    angle = np.arccos(np.clip(dot, 0.0, 1.0))
    near = angle < 1e-6
    sine = np.where(near, 1.0, np.sin(angle))
    first = np.where(near, 1.0 - share, np.sin((1.0 - share) * angle) / sine)
    second = np.where(near, share, np.sin(share * angle) / sine)
    return first * start + second * end


_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_CHUNK = 16  # frames evaluated at once


class AnimatedScene(NamedTuple):
    """What a file shows over time, y up, metres. Rest is the pose that the nodes have without the animation."""

    verts: np.ndarray  # (T, W, 3) float64
    faces: np.ndarray  # (G, 3) int64
    rest: np.ndarray  # (W, 3)
    transforms: np.ndarray | None  # (T, J, 3, 4) of the joints, rest to posed; None without exactly one skin
    weights: np.ndarray | None  # (W, J) of the skin
    joints: tuple[str, ...] = ()  # (J,) their names


def read_gltf_animation(path: Path, fps: float, animation: int | str = 0, parts: Sequence[str] = ()) -> AnimatedScene:
    """All triangle meshes of the file's scene, evaluated at k / fps for as long as the animation lasts.

    Vertices that exporters split along texture seams (equal in the bind pose and in the frames looked at) are joined.

    Args:
        animation: index or name; a file without animations gives one frame.
        parts: names of the nodes or meshes that count; empty: all.

    Raises:
        ValueError: no triangles, an unknown animation or part, damaged or too large; names the file and the fix.
    """
    gltf = read_gltf(path)
    return guarded(path, "glTF file", lambda: _evaluate(gltf, fps, animation, parts))


def _evaluate(gltf: Gltf, fps: float, animation: int | str, parts: Sequence[str]) -> AnimatedScene:
    player = Player(gltf, _choose(gltf, animation))
    meshes = list(_meshes(gltf, player, parts))
    if not meshes:
        raise Refused("no triangle meshes in its scene; export the character's mesh with it")
    times = player.times(fps)
    num_vertices = sum(len(mesh.pos) for mesh in meshes)
    if len(times) * num_vertices * 24 > SIZE_LIMIT:
        raise Refused(f"{len(times)} frames of {num_vertices} vertices are too many; lower fps or shorten the animation")
    verts = np.empty((len(times), num_vertices, 3))
    skin = _common_skin(gltf, meshes)
    still: tuple[Player, np.ndarray, dict] = (Player(gltf, None), np.zeros(1), {})
    rest = np.concatenate([mesh.at(*still) for mesh in meshes], axis=1)[0]
    transforms = []
    for start in range(0, len(times), _CHUNK):
        chunk = times[start : start + _CHUNK]
        worlds: dict[int, np.ndarray] = {}
        verts[start : start + len(chunk)] = np.concatenate([mesh.at(player, chunk, worlds) for mesh in meshes], axis=1)
        if skin is not None:
            transforms.append(player.joint_matrices(skin, chunk, worlds))
    offsets = np.cumsum([0, *(len(mesh.pos) for mesh in meshes)])
    faces = np.concatenate([_outward(mesh, player, times) + offset for mesh, offset in zip(meshes, offsets, strict=False)])
    kept, faces = _weld(np.concatenate([mesh.pos for mesh in meshes]), verts, faces)
    bones, weights = None, None
    names: tuple[str, ...] = ()
    if skin is not None:
        bones = (np.concatenate(transforms) @ np.linalg.inv(still[0].joint_matrices(skin, *still[1:])))[:, :, :3]
        weights = np.concatenate([mesh.weights for mesh in meshes if mesh.weights is not None])[kept]
        names = tuple(str(player.nodes[joint].get("name", joint)) for joint in skin["joints"])
    return AnimatedScene(verts[:, kept], faces, rest[kept], bones, weights, names)


def _common_skin(gltf: Gltf, meshes: Sequence[_Mesh]) -> dict[str, Any] | None:
    """The one skin that all meshes have; None where there is none, several, or a joint is shrunk to nothing at rest."""
    numbers = {mesh.skin for mesh in meshes}
    if len(numbers) > 1 or None in numbers:
        return None
    skin = gltf.item("skins", meshes[0].skin)
    rest = Player(gltf, None).joint_matrices(skin, np.zeros(1), {})
    return skin if (np.abs(np.linalg.det(rest[:, :, :3, :3])) > 1e-12).all() else None


def _choose(gltf: Gltf, animation: int | str) -> dict[str, Any] | None:
    animations = gltf.items("animations")
    if not animations:
        return None
    labels = [str(entry.get("name", index)) for index, entry in enumerate(animations)]
    if isinstance(animation, str) and animation in labels:
        return animations[labels.index(animation)]
    if str(animation).isdigit() and int(animation) < len(animations):
        return animations[int(animation)]
    raise Refused(f"no animation {animation!r}; it has {', '.join(labels[:12])} (or 0 to {len(labels) - 1})")


# ---- meshes ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Mesh:
    """One primitive of one node."""

    node: int
    pos: np.ndarray  # (W, 3)
    faces: np.ndarray  # (G, 3)
    targets: np.ndarray  # (M, W, 3) morph displacements
    skin: int | None
    weights: np.ndarray | None  # (W, J)

    def at(self, player: Player, times: np.ndarray, worlds: dict[int, np.ndarray]) -> np.ndarray:
        """(T, W, 3) in the world."""
        pos = np.broadcast_to(self.pos, (len(times), *self.pos.shape))
        if len(self.targets):
            amounts = player.weights(self.node, times, len(self.targets))
            if amounts.shape[1] != len(self.targets):
                raise Refused(f"node {self.node} animates {amounts.shape[1]} of its {len(self.targets)} morph targets")
            pos = pos + np.tensordot(amounts, self.targets, axes=1)
        if self.skin is None:
            matrix = player.world(self.node, times, worlds)
            return pos @ matrix[:, :3, :3].transpose(0, 2, 1) + matrix[:, None, :3, 3]
        assert self.weights is not None
        # The node's own place is ignored for skinned meshes: the joints say where they are.
        joints = player.joint_matrices(player.gltf.item("skins", self.skin), times, worlds)[:, :, :3]
        blended = (self.weights @ joints.reshape(len(times), -1, 12)).reshape(len(times), -1, 3, 4)
        return np.einsum("twab,twb->twa", blended[..., :3], pos) + blended[..., 3]


def _meshes(gltf: Gltf, player: Player, parts: Sequence[str]) -> Iterator[_Mesh]:
    names = set()
    for node in sorted(_shown(gltf, player)):
        spec = player.nodes[node]
        if "mesh" not in spec:
            continue
        mesh = gltf.item("meshes", spec["mesh"])
        own = {str(spec.get("name", node)), str(mesh.get("name", spec["mesh"]))}
        names |= own
        if parts and not own & set(parts):
            continue
        for primitive in mesh["primitives"]:
            if primitive.get("mode", _TRIANGLES) in (_TRIANGLES, _STRIP, _FAN):
                yield _primitive(gltf, node, spec, primitive)
    missing = set(parts) - names
    if missing:
        raise Refused(f"no part {sorted(missing)[0]!r}; it has {listed(sorted(names), 12)}")


def _outward(mesh: _Mesh, player: Player, times: np.ndarray) -> np.ndarray:
    """Faces (G, 3) that look outwards in the world: a mirrored node turns them over."""
    if mesh.skin is not None or np.linalg.det(player.world(mesh.node, times[:1], {})[0, :3, :3]) >= 0:
        return mesh.faces
    return mesh.faces[:, ::-1]


def _shown(gltf: Gltf, player: Player) -> set[int]:
    """Nodes of the file's scene, or all where it has none."""
    scenes = gltf.items("scenes")
    if not scenes:
        return set(range(len(player.nodes)))
    waiting = list(gltf.item("scenes", gltf.document.get("scene", 0)).get("nodes", []))
    found: set[int] = set()
    while waiting:
        node = waiting.pop()
        gltf.item("nodes", node)
        if node not in found:
            found.add(node)
            waiting += player.nodes[node].get("children", [])
    return found


def _primitive(gltf: Gltf, node: int, spec: dict[str, Any], primitive: dict[str, Any]) -> _Mesh:
    attributes = primitive["attributes"]
    pos = gltf.table(attributes["POSITION"]).astype(np.float64)
    indices = gltf.table(primitive["indices"])[:, 0] if "indices" in primitive else np.arange(len(pos))
    if pos.shape[1] != 3 or (len(indices) and not 0 <= indices.min() <= indices.max() < len(pos)):
        raise Refused(f"a mesh of node {node} refers to vertices beyond its {len(pos)}; the file is damaged")
    moves = [gltf.table(target["POSITION"]) for target in primitive.get("targets", []) if "POSITION" in target]
    if any(move.shape != pos.shape for move in moves) or len(moves) != len(primitive.get("targets", [])):
        raise Refused(f"a morph target of node {node} does not fit its mesh; export the shapes with positions")
    targets = np.array(moves, dtype=np.float64).reshape(len(moves), len(pos), 3)
    weights = None
    if "skin" in spec:
        weights = _skin_weights(gltf, attributes, len(gltf.item("skins", spec["skin"])["joints"]), len(pos))
    return _Mesh(
        node, pos, _triangles(indices.astype(np.int64), primitive.get("mode", _TRIANGLES)), targets, spec.get("skin"), weights
    )


def _skin_weights(gltf: Gltf, attributes: dict[str, Any], num_joints: int, num_vertices: int) -> np.ndarray:
    if num_joints * num_vertices * 8 > SIZE_LIMIT // 2:
        raise Refused(f"{num_joints} joints and {num_vertices} vertices are too many for one skin")
    weights = np.zeros((num_vertices, num_joints))
    rows = np.arange(num_vertices)
    for number in range(8):
        if f"JOINTS_{number}" not in attributes:
            break
        joints = gltf.table(attributes[f"JOINTS_{number}"]).astype(np.int64)
        shares = gltf.table(attributes[f"WEIGHTS_{number}"])
        if joints.shape != (num_vertices, 4) or shares.shape != joints.shape or joints.min() < 0 or joints.max() >= num_joints:
            raise Refused("skin weights do not fit their mesh; the file is damaged")
        for column in range(4):
            np.add.at(weights, (rows, joints[:, column]), shares[:, column])
    total = weights.sum(axis=1, keepdims=True)
    if not (total > 0).all():
        raise Refused(f"vertex {int(np.argmin(total))} follows no joint; weight it in the skin")
    return weights / total


def _triangles(indices: np.ndarray, mode: int) -> np.ndarray:
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    first = np.arange(max(len(indices) - 2, 0))
    if mode == _FAN:
        return np.stack([indices[np.zeros_like(first)], indices[first + 1], indices[first + 2]], axis=1)
    turn = first % 2  # every second triangle of a strip runs the other way
    return np.stack([indices[first], indices[first + 1 + turn], indices[first + 2 - turn]], axis=1)


def _weld(rest: np.ndarray, verts: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices that stay and faces: those that coincide in the bind pose and in the first, middle and last frame become one,
    in order of appearance."""
    looked = [rest, verts[0], verts[len(verts) // 2], verts[-1]]
    # Copies along a seam go through the same arithmetic; the grid absorbs the last digits only.
    grid = 1e-9 * max(float(np.abs(verts[0]).max(initial=0.0)), 1e-3)
    key = np.round(np.concatenate(looked, axis=1) / grid)
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    faces = np.argsort(order)[inverse.reshape(-1)][faces]
    split = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return first[order], faces[split]
