"""The reference model written down once more, naively: float64, one concatenation per network, no shared code.

It reads a state dict by the names in the file. Of the package under test it uses nothing; coarse edges are given to it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

LAYOUTS = ("postcvpr", "cvpr", "fine15", "fine48")
OURS = [("coarse0", "mesh")] * 3 + [("coarse0", "coarse1")] * 3 + [("coarse1",)] * 3
OURS = OURS + [("coarse0", "coarse1")] * 3 + [("coarse0", "mesh")] * 3
REFERENCE_NAME = {"mesh": "mesh_edge", "world": "world_edge", "coarse0": "coarse_edge0", "coarse1": "coarse_edge1"}
CLOTH, BODY, OMITTED, PINNED = 0, 1, 2, 3


def sets_of(layout: str, step: int) -> tuple[str, ...]:
    return OURS[step] if layout in ("postcvpr", "cvpr") else ("mesh",)


def num_steps(layout: str) -> int:
    return 48 if layout == "fine48" else 15


def step_name(layout: str, step: int, name: str) -> str:
    """Key of one network of a processor step; ``name`` is node, mesh, world, coarse0 or coarse1."""
    if layout.startswith("fine"):
        return f"processor_steps.{step}.{REFERENCE_NAME.get(name, name)}_processor"
    block = f"levels.{step // 3}" if layout == "postcvpr" else f"processor_steps{step // 3 + 1}"
    kind = "node_processor_dict.node" if name == "node" else f"edge_processor_dict.{REFERENCE_NAME[name]}"
    return f"{block}.{step % 3}.{kind}"


# ---- a state dict with random weights --------------------------------------------------------------------------------


def make_state(layout: str, latent: int = 16, seed: int = 0) -> dict[str, Tensor]:
    """A float32 state dict in ``layout`` with random weights and statistics of the size that cloth has."""
    generator = torch.Generator().manual_seed(seed)
    ours = not layout.startswith("fine")
    node_width = 24 if ours else 20
    net = "model._learned_model."
    state: dict[str, Tensor] = {}

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    def mlp(name: str, in_width: int, out_width: int = latent, norm: bool = True) -> None:
        layers = f"{name}.0.layers" if norm else f"{name}.layers"
        for index, (rows, columns) in zip((0, 2, 4), ((latent, in_width), (latent, latent), (out_width, latent)), strict=True):
            state[f"{layers}.{index}.weight"] = normal(rows, columns) / columns**0.5
            state[f"{layers}.{index}.bias"] = 0.1 * normal(rows)
        if norm:
            state[f"{name}.1.weight"] = 1 + 0.2 * normal(out_width)
            state[f"{name}.1.bias"] = 0.1 * normal(out_width)

    def statistics(name: str, mean: list[float], std: list[float]) -> None:
        count = 1234.0
        centre = torch.tensor(mean) + 0.1 * torch.tensor(std) * normal(len(std))
        spread = torch.tensor(std) * (1 + 0.2 * torch.rand(len(std), generator=generator))
        prefix = f"model._{name}_normalizer._"
        state[prefix + "acc_count"] = torch.tensor(count)
        state[prefix + "num_accumulations"] = torch.tensor(321.0)
        state[prefix + "acc_sum"] = centre * count
        state[prefix + "acc_sum_squared"] = (spread**2 + centre**2) * count

    mlp(net + "node_encoder", node_width)
    coarse = {"postcvpr": ["coarse0", "coarse1", "coarse2"], "cvpr": ["coarse"]}.get(layout, [])
    for name in ("mesh", *coarse):
        mlp(f"{net}edgeset_encoders.{name}", 12)
    mlp(f"{net}edgeset_encoders.world", 9)
    mlp(net + "decoder", latent, 3, norm=False)
    for step in range(num_steps(layout)):
        sets = (*sets_of(layout, step), "world")
        for name in sets:
            mlp(net + step_name(layout, step, name), 3 * latent)
        mlp(net + step_name(layout, step, "node"), (1 + len(sets)) * latent)
    state["model.nodetype_embedding.weight"] = normal(9, 9)
    if ours:
        state["model.vertexlevel_embedding.weight"] = normal(4, 4)
    statistics("output", [0, -1e-3, 0], [2e-3] * 3)
    embedded = [0.0] * (13 if ours else 9)
    tail = [0, 0, 0, 0.05, -6.0]
    statistics("node", [0, 0, 0, *embedded, *tail], [0.01] * 3 + [1.0] * len(embedded) + [0.5] * 3 + [0.06, 2.0])
    statistics("mesh_edge", [0, 0, 0, 0.05, 0, 0, 0, 0.05, 0.05], [0.04] * 8 + [0.06])
    statistics("world_edge", [0, 0, 0, 0.02, 0, 0, 0, 0.02, 0.05], [0.01] * 8 + [0.06])
    return state


# ---- the model -------------------------------------------------------------------------------------------------------


@dataclass
class OracleScene:
    """One garment and one body; arrays are float64, lists of edges undirected."""

    rest: np.ndarray
    faces: np.ndarray
    pinned: np.ndarray
    coarse: list[np.ndarray]  # three levels
    density: float
    lame_mu: float
    lame_lambda: float
    bending: float
    body_faces: np.ndarray
    body_type: np.ndarray
    radius: float = 0.03


@dataclass
class OracleStep:
    """What a step is given: ``x`` and ``x_before`` before pinned vertices are moved."""

    x: Tensor
    x_before: Tensor
    carried: Tensor | None  # velocity that the step before predicted; None in the first step
    target: Tensor
    body_before: Tensor
    body_now: Tensor
    body_next: Tensor
    timestep: float


@dataclass
class Edges:
    senders: Tensor
    receivers: Tensor
    latent: Tensor


class Oracle:
    """The published model of ``layout`` with the weights ``state``."""

    def __init__(self, layout: str, state: dict[str, Tensor]) -> None:
        self.layout = layout
        self.state = {name: value.double() for name, value in state.items()}
        self.latent = len(state["model._learned_model.node_encoder.0.layers.0.bias"])
        self.ours = layout in ("postcvpr", "cvpr")

    def mlp(self, name: str, x: Tensor, norm: bool = True) -> Tensor:
        name = "model._learned_model." + name
        layers = f"{name}.0.layers" if norm else f"{name}.layers"
        for index in (0, 2, 4):
            x = functional.linear(x, self.state[f"{layers}.{index}.weight"], self.state[f"{layers}.{index}.bias"])
            x = torch.relu(x) if index < 4 else x
        if norm:
            x = functional.layer_norm(x, (x.shape[1],), self.state[f"{name}.1.weight"], self.state[f"{name}.1.bias"])
        return x

    def statistics(self, name: str) -> tuple[Tensor, Tensor]:
        prefix = f"model._{name}_normalizer._"
        count = max(float(self.state[prefix + "acc_count"]), 1.0)
        mean = self.state[prefix + "acc_sum"] / count
        variance = self.state[prefix + "acc_sum_squared"] / count - mean**2
        return mean, torch.maximum(torch.sqrt(variance), double(1e-8))

    def normalise(self, name: str, x: Tensor) -> Tensor:
        mean, std = self.statistics(name)
        return torch.cat([(x[:, : len(mean)] - mean) / std, x[:, len(mean) :]], dim=1)

    def acceleration(self, scene: OracleScene, step: OracleStep) -> Tensor:
        """Predicted displacement per frame² (V, 3), pinned vertices included."""
        return self.predict(scene, step)[0]

    def predict(self, scene: OracleScene, step: OracleStep) -> tuple[Tensor, Tensor, Tensor]:
        """Acceleration, and position and velocity after the step."""
        pinned = torch.as_tensor(scene.pinned)[:, None]
        before = torch.where(pinned, step.x, step.x_before)
        x = torch.where(pinned, step.target, step.x)
        velocity = x - before
        if self.layout == "postcvpr":
            velocity = step.x - step.x_before if step.carried is None else step.carried
        nodes = self.node_features(scene, step, x, velocity)
        edges = self.edge_sets(scene, step, x)
        latent = self.mlp("node_encoder", self.normalise("node", nodes))
        latent = self.process(scene, latent, edges)
        mean, std = self.statistics("output")
        acceleration = self.mlp("decoder", latent[: len(x)], norm=False) * std + mean
        velocity = velocity + acceleration
        following = torch.where(pinned, step.target, x + velocity)
        return acceleration, following, torch.where(pinned, 0.0, velocity)

    def node_features(self, scene: OracleScene, step: OracleStep, x: Tensor, velocity: Tensor) -> Tensor:
        moved = step.body_now - step.body_before if self.layout == "postcvpr" else step.body_next - step.body_now
        types = torch.as_tensor(np.where(scene.pinned, PINNED, CLOTH)), torch.as_tensor(scene.body_type)
        levels = torch.tensor(node_levels(scene)), torch.zeros(len(moved), dtype=torch.int64)
        normal = normals(x, scene.faces), normals(step.body_now, scene.body_faces)
        log_mass = torch.log(torch.clamp(masses(scene), min=1e-9))
        last = torch.cat([log_mass[:, None], column(unit_material(scene), x)], dim=1), column(double(-1, -1, -1, -1), moved)
        blocks = []
        for k, motion in enumerate((velocity, moved)):
            parts = [motion, self.state["model.nodetype_embedding.weight"][types[k]]]
            parts += [self.state["model.vertexlevel_embedding.weight"][levels[k]]] if self.ours else []
            blocks.append(torch.cat([*parts, normal[k], column(double(step.timestep), motion), last[k]], dim=1))
        return torch.cat(blocks)

    def edge_sets(self, scene: OracleScene, step: OracleStep, x: Tensor) -> dict[str, Edges]:
        rest = torch.as_tensor(scene.rest)
        lists = {"mesh": np.array(mesh_edges(scene.faces))}
        if self.ours:
            lists |= {f"coarse{k}": np.asarray(edges) for k, edges in enumerate(scene.coarse[:2])}
        sets = {}
        for name, pairs in lists.items():
            senders, receivers = torch.as_tensor(np.concatenate([pairs, pairs[:, ::-1]]).T.copy())
            now, before = relative(x[senders] - x[receivers]), relative(rest[senders] - rest[receivers])
            features = [now, before, column(double(step.timestep), now), column(unit_material(scene), now)]
            encoder = "coarse" if name != "mesh" and self.layout == "cvpr" else name
            latent = self.mlp(f"edgeset_encoders.{encoder}", self.normalise("mesh_edge", torch.cat(features, dim=1)))
            sets[name] = Edges(senders, receivers, latent)
        sets["world"] = self.world_edges(scene, step, x)
        return sets

    def world_edges(self, scene: OracleScene, step: OracleStep, x: Tensor) -> Edges:
        cloth, body = [], []
        for i in range(len(x)):
            distance = (step.body_now - x[i]).norm(dim=1)
            j = int(distance.argmin())
            if float(distance[j]) < scene.radius and scene.body_type[j] != OMITTED:
                cloth.append(i)
                body.append(j)
        i, j = torch.tensor(cloth, dtype=torch.int64), torch.tensor(body, dtype=torch.int64)
        rows = []
        for sign in (1.0, -1.0):  # from the body to the cloth, and back
            now, later = relative(sign * (step.body_now[j] - x[i])), relative(sign * (step.body_next[j] - x[i]))
            rows.append(torch.cat([now, later, column(double(step.timestep), now)], dim=1))
        latent = self.mlp("edgeset_encoders.world", self.normalise("world_edge", torch.cat(rows)))
        return Edges(torch.cat([len(x) + j, i]), torch.cat([i, len(x) + j]), latent)

    def process(self, scene: OracleScene, nodes: Tensor, edges: dict[str, Edges]) -> Tensor:
        for step in range(num_steps(self.layout)):
            sets = sets_of(self.layout, step)
            finest = min(0 if name == "mesh" else int(name[-1]) + 1 for name in sets)
            sums = {}
            for name in (*sets, "world"):
                part = edges[name]
                chosen = torch.arange(len(part.senders))
                if name == "world" and finest > 0:
                    cloth_end = torch.minimum(part.senders, part.receivers)
                    chosen = chosen[torch.isin(cloth_end, torch.as_tensor(np.asarray(scene.coarse[finest - 1]).copy()))]
                senders, receivers = part.senders[chosen], part.receivers[chosen]
                inputs = torch.cat([nodes[receivers], nodes[senders], part.latent[chosen]], dim=1)
                message = self.mlp(step_name(self.layout, step, name), inputs)
                sums[name] = torch.zeros_like(nodes).index_add(0, receivers, message)
                part.latent = part.latent.index_add(0, chosen, message)
            order = [nodes, *(sums[name] for name in (*sets, "world"))]
            if not self.ours:
                order = [sums["mesh"], sums["world"], nodes]
            nodes = nodes + self.mlp(step_name(self.layout, step, "node"), torch.cat(order, dim=1))
        return nodes

    def rollout(
        self, scene: OracleScene, start: Tensor, body: list[Tensor], targets: list[Tensor], held: Tensor
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Accelerations and positions of one relaxing step, from rest, and of the regular ones that follow, as far as the
        body goes.

        postcvpr holds the body still in frame 0 while the cloth relaxes, then goes 0 → 1, 1 → 2, …, and carries the velocity
        of every step into the next. The other three take body and pins from 0 to 1 in the relaxing step, then go 1 → 2,
        2 → 3, …; after the relaxing step the position before is set to the present one, so that the velocity is 0.

        ``body`` and ``targets`` by frame; vertices ``held`` (V,) bool are massless and stay.
        """
        still = self.layout == "postcvpr"
        frames = [(0, 0), *((t, t + 1) for t in range(len(body) - 1))] if still else [(t, t + 1) for t in range(len(body) - 1)]
        x, before, carried = start, start, None
        for step, (now, after) in enumerate(frames):
            timestep, target = 1 / 30 if step else 1 / 3, targets[after]
            inputs = OracleStep(x, before, carried, target, body[max(now - 1, 0)], body[now], body[after], timestep)
            acceleration, following, carried = self.predict(scene, inputs)
            following = torch.where(held[:, None], x, following)
            carried = torch.where(held[:, None], 0.0, carried)
            # The pinned vertices' position before the step is the one they were moved to.
            before = torch.where(torch.as_tensor(scene.pinned)[:, None], target, x)
            if step == 0 and not still:
                before = following
            x = following
            yield acceleration, following


# ---- geometry --------- -----------------------------------------------------------------------------------------------


def mesh_edges(faces: np.ndarray) -> list[tuple[int, int]]:
    pairs = {tuple(sorted((int(f[k]), int(f[(k + 1) % 3])))) for f in faces for k in range(3)}
    return sorted(pairs)


def double(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def column(values: Tensor, like: Tensor) -> Tensor:
    """``values`` (C,) in every row of a table as long as ``like``."""
    return values.expand(len(like), -1)


def relative(vector: Tensor) -> Tensor:
    return torch.cat([vector, vector.norm(dim=1, keepdim=True)], dim=1)


def normals(pos: Tensor, faces: np.ndarray) -> Tensor:
    a, b, c = torch.as_tensor(faces).T
    cross = torch.linalg.cross(pos[b] - pos[a], pos[c] - pos[a])  # twice the area times the unit normal
    total = torch.zeros_like(pos).index_add(0, a, cross).index_add(0, b, cross).index_add(0, c, cross)
    return total / total.norm(dim=1, keepdim=True).clamp_min(1e-30)


def masses(scene: OracleScene) -> Tensor:
    rest, (a, b, c) = torch.as_tensor(scene.rest), torch.as_tensor(scene.faces).T
    share = scene.density * 0.5 * torch.linalg.cross(rest[b] - rest[a], rest[c] - rest[a]).norm(dim=1) / 3
    return torch.zeros(len(rest), dtype=torch.float64).index_add(0, a, share).index_add(0, b, share).index_add(0, c, share)


def node_levels(scene: OracleScene) -> list[int]:
    """Deepest of the three coarse levels in which a vertex has an edge; 0 is the mesh."""
    levels = [0] * len(scene.rest)
    for level, edges in enumerate(scene.coarse[:3], start=1):
        for vertex in np.asarray(edges).reshape(-1).tolist():
            levels[vertex] = level
    return levels


def unit_material(scene: OracleScene) -> Tensor:
    def log(value: float, low: float, high: float) -> float:
        return (np.log(value) - np.log(low)) / (np.log(high) - np.log(low))

    lam = (scene.lame_lambda - 3535.414) / (93333.735 - 3535.414)
    values = [log(scene.bending, 6.3708e-8, 1.31397e-3), log(scene.lame_mu, 15909.0, 63636.0), lam]
    return double(*values)
