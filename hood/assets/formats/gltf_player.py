"""Where the nodes of an animated glTF scene are at any time: keys, interpolation, hierarchy (glTF 2.0, section 3.11)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.files.guarded import Refused
from hood.assets.formats.gltf import Gltf

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
