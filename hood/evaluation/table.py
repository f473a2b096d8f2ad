"""The paper's Table 1: cost, reach and accuracy of several models on one fixed list of garments and motions.

Propagation radius of a network, measured: how far a node's input reaches in one step.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.csgraph import shortest_path
from torch import Tensor

from hood.assets.material import Material
from hood.cloth.cloth import Cloth, build_cloth
from hood.cloth.state import StepInput
from hood.energies.potential import Potential
from hood.evaluation.bootstrap import pooled_interval
from hood.evaluation.gap import AGREEMENT, REFERENCE, StepSample, gap
from hood.evaluation.spectrum import error_spectrum, garment_bands
from hood.model.graph.builder import LAYERS, Graph, build_graph, build_static
from hood.model.graph.hierarchy import build_hierarchy
from hood.model.network.model import MeshGraphNet
from hood.rollouts.frame import Frame
from hood.rollouts.frames import KeptFrames
from hood.rollouts.loop import simulate
from hood.rollouts.verdict.rule import Verdict, judge_rollout
from hood.scene.scene import Scene
from hood.solver.newton import NewtonSettings
from hood.steppers.network import NetworkStepper
from hood.steppers.newton import Stepper
from hood.steppers.static_shapes.simulator import network_of

_LENGTH = 128  # edges along the strip: its diameter must exceed twice the largest radius
_TRIES = 4  # inputs per node; a ReLU may block a path for one input


def measured_radius(simulator: NetworkStepper, seed: int = 0) -> int:
    """Farthest mesh-hop distance between nodes i and j at which ∂a_j/∂(velocity feature of i) is not zero.

    Float64 autograd on a strip of diameter > 100 without body edges; random features; maximum over nodes of every level, the
    coarsest among them. The farthest path of a multi-level schedule may start on any level. Of a network of several passes it
    is the reach of all its steps together; what the potential tells it between two passes is not counted.
    """
    network = copy.deepcopy(simulator.network).cpu().double().eval()
    network.use_precision("fp32")  # of products in float64: as they come
    network.use_kernels("torch")
    columns = simulator.velocity_columns
    cloth = _strip()
    edges = cloth.edges.numpy()
    hierarchy = build_hierarchy(cloth.num_vertices, edges, cloth.rest_pos.numpy(), simulator.num_coarse)
    static = build_static(cloth, hierarchy, network.edge_set_names)
    apart = static.mesh_edges[:0] if LAYERS in network.world_sets else None
    graph = build_graph(static, StepInput(dt=torch.full((1,), 1.0 / 30.0, dtype=torch.float64)), layers=apart)
    hops = _hops(cloth.num_vertices, edges)
    generator = torch.Generator().manual_seed(seed)
    targets = _targets(hierarchy.node_level)
    farthest = 0
    for _ in range(_TRIES):
        features = _random_features(network, graph, generator)
        nodes = features.pop("nodes").requires_grad_(True)
        output = network(graph, nodes, features, partial(_unseen, network, graph))
        for target in targets:
            (gradient,) = torch.autograd.grad(output[target].sum(), nodes, retain_graph=True)
            reached = gradient[:, columns].abs().amax(dim=1) > 0
            # A dead ReLU may cut a target off altogether; it then says nothing about the reach.
            farthest = max(farthest, int(hops[target][reached.numpy()].max(initial=0)))
    return farthest


def _targets(node_level: Tensor) -> list[int]:
    """First, middle and last node of every level."""
    chosen = []
    for level in node_level.unique():
        nodes = torch.nonzero(node_level == level).squeeze(1)
        chosen += [int(nodes[0]), int(nodes[len(nodes) // 2]), int(nodes[-1])]
    return sorted(set(chosen))


def _strip() -> Cloth:
    """A strip of ``_LENGTH`` × 1 squares, each split into two triangles."""
    columns = np.arange(_LENGTH + 1)
    pos = np.array([[0.01 * i, 0.01 * j, 0.0] for i in columns for j in (0, 1)])
    quads = [(2 * i, 2 * i + 1, 2 * i + 2, 2 * i + 3) for i in range(_LENGTH)]
    faces = np.array([triangle for a, b, c, d in quads for triangle in ((a, c, b), (b, c, d))])
    return build_cloth(pos, faces, Material(), dtype=torch.float64)


def _hops(num_vertices: int, edges: np.ndarray) -> np.ndarray:
    ones = np.ones(len(edges))
    graph = sparse.csr_matrix((ones, (edges[:, 0], edges[:, 1])), shape=(num_vertices, num_vertices))
    return shortest_path(graph, directed=False, unweighted=True).astype(int)


def _unseen(network: MeshGraphNet, graph: Graph, index: int, raw: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """Instead of what the pass after ``index`` is shown of the cloth: nothing, so that steps alone carry."""

    def nothing(rows: int, encoder: torch.nn.Module) -> Tensor:
        return raw.new_zeros(rows, next(encoder.parameters()).shape[1])

    edge_looks = cast(torch.nn.ModuleDict, network.edge_looks[index])
    edges = {name: nothing(graph.edge_sets[name].num_edges, encoder) for name, encoder in edge_looks.items()}
    return nothing(graph.num_cloth, network.node_looks[index]), edges


def _random_features(network: MeshGraphNet, graph: Graph, generator: torch.Generator) -> dict[str, Tensor]:
    def draw(rows: int, encoder: torch.nn.Module) -> Tensor:
        width = next(encoder.parameters()).shape[1]
        return torch.randn(rows, width, generator=generator, dtype=torch.float64)

    features = {"nodes": draw(graph.num_nodes, network.node_encoder)}
    for name in (*network.edge_set_names, *network.world_sets):
        features[name] = draw(graph.edge_sets[name].num_edges, network.edge_encoder(name))
    return features


#: Frames at the start of a rollout that are left out of the times: caches fill and pages are mapped there.
_WARMUP = 2
ALL = "all"
#: ``models=[newton]``: no network, the potential minimised in every frame.
NEWTON = "newton"
#: No network either: where the solver starts, the inertial guess out of contact.
GUESS = "guess"
#: A frame whose 99th percentile of strain exceeds this is a failure: a hundredth of its edges is twice as long as at rest.
FAILURE_STRAIN = 1.0
#: Columns that have a confidence interval NAME_low, NAME_high: of what they are which figure.
_STATISTICS: dict[str, tuple[str, Callable[[np.ndarray], float]]] = {
    "ms": ("ms_total", np.median),
    "L_total": ("energy_total", np.mean),
    "gradient_norm": ("gradient_norm", np.mean),
    "rg": ("relative_gradient", np.median),
    "gap": ("gamma", np.median),
    "strain_p99": ("strain_p99", np.median),
}
INTERVALS = tuple(_STATISTICS)
#: Energies that every row has, in their order; and how metrics of frames name an energy.
TERMS = ("stretching", "bending", "inertia", "gravity", "collision", "friction")
_SUMS, _ENERGY = (*TERMS, "total"), "energy_"

#: Told what is being done and how many rollouts are done.
_Progress = Callable[[str, int], None]
#: Shown every frame of a rollout.
See = Callable[[Frame], None]


@dataclass(frozen=True)
class Candidate:
    """What takes the steps, what its weights are (``none`` for the solver), and what they cost, as far as their file says."""

    name: str
    weights: str
    stepper: Stepper
    training: str = ""


@dataclass(frozen=True)
class GapSettings:
    """How many gaps are computed and how exactly.

    Args:
        states: steps of every rollout, spread evenly over its frames; 0 for no gap and no minimisation.
        reference: how far the minimisations behind a gap go.
        spectrum: of the same states, in which wavelengths the error is.
    """

    states: int = 5
    reference: NewtonSettings = REFERENCE
    spectrum: bool = False


@dataclass
class MeasuredRollout:
    """What rollouts gave, as plain numbers: it can be written down and added up in any order."""

    frames: list[dict[str, float]] = field(default_factory=list)  # metrics of the finite frames that count
    failures: list[int] = field(default_factory=list)  # first non-finite frames
    #: Of every state looked at: γ, converged (0 or 1), spread [e0], L and what it is above the minimum [J].
    gaps: list[dict[str, float]] = field(default_factory=list)
    drifts: list[float] = field(default_factory=list)  # [m] to the side, on a body that stands still
    ends: list[int | None] = field(default_factory=list)  # of every rollout: first frame failed, see FAILURE_STRAIN; None: none

    #: Of every rollout why it is unsound, by the rule; []: sound; None: not known.
    kinds: list[list[str] | None] = field(default_factory=list)
    spectra: list[dict[str, Any]] = field(default_factory=list)  # of the states of gaps, see error_spectrum
    worn: list[float] = field(default_factory=list)  # of every rollout the share of its frames before the cloth came off

    def __add__(self, other: MeasuredRollout) -> MeasuredRollout:
        return MeasuredRollout(*(getattr(self, item.name) + getattr(other, item.name) for item in fields(self)))


def evaluate(
    candidates: Sequence[Candidate],
    scenes: Mapping[str, Sequence[Scene]],
    potential: Potential,
    num_frames: int,
    gaps: GapSettings | None = None,
    progress: _Progress = lambda text, done: None,
) -> list[dict[str, Any]]:
    """Rows of the table: one per candidate and garment, and one per candidate over all garments.

    Means over the frames that a candidate's own rollouts reach before the first non-finite one; ``failed_at`` is the earliest
    such frame (None: never). ``sound`` is the share of rollouts that :mod:`hood.rollouts.verdict` calls so, ``unsound_for``
    what the others were called unsound for, and how many, ``worn`` the share of the frames before a part of the garment has
    come off the body (:mod:`hood.rollouts.verdict.worn`) or one that is not finite; ``distance`` [m] the median over frames of
    the 99th percentile of the distance to the minimum of a step. Of the ``rollouts``, ``failed`` is the share that failed, as
    non-finite or by :data:`FAILURE_STRAIN`, and ``frames_to_failure`` the median of the frames where they did, rollouts that
    lasted counted as later than all (None: less than half failed). ``steps`` and ``radius`` are None without a network.
    ``network`` says what kind it is, ``as_in_paper`` whether latent, features and output are those of the paper. ``L_NAME`` is
    the energy of every term that acts in the row, those of :data:`TERMS` in any case, ``L_total`` their sum, ``L_guess`` the
    potential of the inertial guess on the same states. ``gradient_norm`` [N] is the mean over vertices of ‖∂L/∂x_v‖₂, averaged
    over frames; ``rg`` and ``strain_p99`` are medians over frames; ``penetration`` is the mean share of vertices deeper than 2
    mm, ``penetration_worst`` that of the worst frame; ``cut_faces`` is the mean share of the cloth's triangles that the body
    cuts, ``cut_faces_worst`` that of the worst frame, ``crossings`` the mean number of pairs of cloth triangles that pass
    through each other, all three of the frames where they are measured; ``drift`` [m] is the largest of those measured (None:
    none was). Of the states whose gap is computed (``gap_states`` of them): ``gap`` is the median, ``gap_p95`` the 95th
    percentile, ``unconverged`` the share whose reference missed its accuracy and ``disagree`` the share where minimisations
    ended in different minima, ``gap_spread`` [e0] the 95th percentile of how far these are apart; ``L_states`` is L_total of
    these states alone and ``L_above`` what it is above their minima [J], both medians. Columns of :data:`INTERVALS` have 95%
    intervals over rollouts, ``NAME_low`` and ``NAME_high``, from two rollouts on.
    """
    rows, done = [], 0
    for candidate in candidates:
        parts: dict[str, list[MeasuredRollout]] = {garment: [] for garment in scenes}
        for garment, variants in scenes.items():
            for scene in variants:
                tell = partial(_tell, progress, done)
                parts[garment].append(measure(candidate, scene, potential, num_frames, gaps, tell))
                done += 1
                progress(f"{candidate.name} {garment} {scene.motion.name}", done)
        rows += candidate_rows(candidate, parts)
    return rows


def measure(
    candidate: Candidate,
    scene: Scene,
    potential: Potential,
    num_frames: int,
    gaps: GapSettings | None = None,
    tell: Callable[[str], None] = lambda text: None,
    see: See | None = None,
) -> MeasuredRollout:
    """One rollout of a candidate; ``tell`` hears what is being done, ``see`` is shown every frame."""
    measured, kept = MeasuredRollout(), KeptFrames()

    def seen(frame: Frame) -> None:
        kept.see(scene, frame)
        if see is not None:
            see(frame)

    for text in _run(candidate.stepper, scene, potential, num_frames, gaps or GapSettings(), measured, seen):
        tell(f"{candidate.name} {scene.garment.name} {scene.motion.name} {text}")
    verdict = judge_rollout(kept.data())
    measured.kinds.append(None if verdict.sound is None else [reason.kind for reason in verdict.reasons])
    measured.worn.append(_worn_share(verdict, min(num_frames, scene.num_frames)))
    return measured


def _worn_share(verdict: Verdict, count: int) -> float:
    """The share of ``count`` frames before the first that is not finite, or in which a part of the garment has come off."""
    lost = [reason.frames[0][0] for reason in verdict.reasons if reason.kind in ("not_worn", "not_finite") and reason.frames]
    return min([count, *lost]) / count


def candidate_rows(candidate: Candidate, parts: Mapping[str, Sequence[MeasuredRollout]]) -> list[dict[str, Any]]:
    """The candidate's rows of the table, from its rollouts by garment: one per garment and one over all, see
    :func:`evaluate`."""
    shared = {"model": candidate.name, "weights": candidate.weights, **_reach(candidate.stepper)}
    whole = [rollout for part in parts.values() for rollout in part]
    return [
        {**shared, "garment": name, **_row(sum(part, start=MeasuredRollout())), **_intervals(part)}
        for name, part in {**parts, ALL: whole}.items()
    ]


def other_terms(rows: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Energies that act in some of the rows beside :data:`TERMS`, own ones among them: their columns are ``L_NAME``."""
    known = {f"L_{name}" for name in (*_SUMS, "guess", "states", "above", "total_low", "total_high")}
    columns = (key for row in rows for key in row if key.startswith("L_") and key not in known)
    return tuple(dict.fromkeys(column.removeprefix("L_") for column in columns))


def _tell(progress: _Progress, done: int, text: str) -> None:
    progress(text, done)


def _reach(stepper: Stepper) -> dict[str, Any]:
    """Steps, radius and kind of a network; ``as_in_paper`` says whether all but its schedule is that of the paper."""
    network = network_of(stepper)
    if network is None:
        return {"steps": None, "radius": None}
    features, output, latent = (network.config.get(key) for key in ("features", "output", "latent_dim"))
    return {
        "steps": len(network.schedule),
        "radius": measured_radius(network),
        "network": f"latent {latent}, features {features}, output {output}",
        "as_in_paper": (features, output, latent) == ("paper", "acceleration", 128),
    }


def _run(
    stepper: Stepper, scene: Scene, potential: Potential, num_frames: int, gaps: GapSettings, into: MeasuredRollout, see: See
) -> Iterator[str]:
    """One rollout, added to ``into``; yields what is being done."""
    count, end = min(num_frames, scene.num_frames), None
    sample = StepSample(range(_WARMUP + 1, count), gaps.states)
    for frame in simulate(stepper, scene, potential, count, observe=sample if gaps.states else None):
        see(frame)
        yield f"frame {frame.index + 1}/{count}"
        strain = frame.metrics["strain_p99"]
        if end is None and not strain <= FAILURE_STRAIN:
            end = frame.index
        if not np.isfinite(strain):
            into.failures.append(frame.index)
            break
        if frame.index > _WARMUP:
            into.frames.append(frame.metrics)
    into.ends.append(end)
    bands = garment_bands(scene.cloth) if gaps.spectrum and sample.steps else None
    for index, (problem, prediction) in enumerate(sample.steps):
        yield f"gap {index + 1}/{len(sample.steps)}"
        found = gap(potential, problem, prediction.next_pos, settings=gaps.reference)
        numbers = {"gamma": found.gamma, "converged": found.converged, "spread": found.spread}
        numbers |= {"phi": found.phi, "above": found.phi - found.reference}
        into.gaps.append({name: float(value) for name, value in numbers.items()})
        if bands is not None:
            into.spectra.append(error_spectrum(potential, problem, prediction.next_pos, bands, gaps.reference))


def _row(measured: MeasuredRollout) -> dict[str, Any]:
    frames, failures = measured.frames, measured.failures
    row: dict[str, Any] = {"frames": len(frames), "failed_at": min(failures) if failures else None}
    row |= _failure_columns(measured.ends) | _verdict_columns(measured.kinds) | _gap_columns(measured.gaps)
    if measured.worn:
        row["worn"] = float(np.mean(measured.worn))
    if measured.drifts:
        row["drift"] = max(measured.drifts)
    if not frames:
        return row
    times = np.array([frame["ms_total"] for frame in frames])
    row |= {
        "ms": float(np.median(times)),
        "ms_p99": float(np.quantile(times, 0.99)),
        "fps": float(1e3 / np.median(times)),
    }
    others = (key.removeprefix(_ENERGY) for frame in frames for key in frame if key.startswith(_ENERGY))
    for name in dict.fromkeys((*_SUMS, *others)):
        row[f"L_{name}"] = _mean(frames, f"{_ENERGY}{name}")
    row["L_guess"] = row.pop("L_inertial_guess", 0.0)
    row["gradient_norm"] = _mean(frames, "gradient_norm")
    row["penetration"] = _mean(frames, "penetration_share")
    row["penetration_worst"] = max(frame.get("penetration_share", 0.0) for frame in frames)
    row |= _surface_columns(frames)
    row["strain_p99"] = float(np.median([frame["strain_p99"] for frame in frames]))
    distance = [frame["distance_p99"] for frame in frames if np.isfinite(frame.get("distance_p99", np.nan))]
    row["distance"] = float(np.median(distance)) if distance else None
    row["rg"] = float(np.median([frame["relative_gradient"] for frame in frames]))
    return row


def _surface_columns(frames: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """Of the frames whose surface was measured; nothing where none was."""
    measured = [frame for frame in frames if np.isfinite(frame.get("cut_face_share", np.nan))]
    if not measured:
        return {}
    return {
        "cut_faces": _mean(measured, "cut_face_share"),
        "cut_faces_worst": max(frame["cut_face_share"] for frame in measured),
        "crossings": _mean(measured, "self_crossings") + _mean(measured, "garment_crossings"),
    }


def _failure_columns(ends: Sequence[int | None]) -> dict[str, Any]:
    if not ends:
        return {"rollouts": 0}
    frames = sorted(np.inf if end is None else end for end in ends)
    median = frames[(len(frames) - 1) // 2]
    return {
        "rollouts": len(ends),
        "failed": float(np.mean(np.isfinite(frames))),
        "frames_to_failure": int(median) if np.isfinite(median) else None,
    }


def _verdict_columns(kinds: Sequence[Sequence[str] | None]) -> dict[str, Any]:
    """The share of rollouts that the rule calls sound, of those that it judges, and what the others are called for; nothing of
    earlier logs, and where none was judged."""
    judged = [one for one in kinds if one is not None]
    if not judged:
        return {}
    counts = Counter(kind for one in judged for kind in dict.fromkeys(one))
    return {
        "sound": sum(not one for one in judged) / len(judged),
        "unsound_for": ", ".join(f"{k} {n}" for k, n in counts.most_common()),
    }


def _intervals(rollouts: Sequence[MeasuredRollout]) -> dict[str, float]:
    """``NAME_low`` and ``NAME_high`` of the columns of :data:`INTERVALS` that have one."""
    found: dict[str, float] = {}
    for column, (key, statistic) in _STATISTICS.items():
        tables = [one.gaps if column == "gap" else one.frames for one in rollouts]
        low, high = pooled_interval([[item.get(key, 0.0) for item in table] for table in tables], statistic)
        if np.isfinite(low) and np.isfinite(high):
            found |= {f"{column}_low": low, f"{column}_high": high}
    return found


def _gap_columns(gaps: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    if not gaps:
        return {"gap_states": 0}
    gamma = np.array([item["gamma"] for item in gaps])
    spread = np.array([item["spread"] for item in gaps])
    known = spread[np.isfinite(spread)]
    told = [item for item in gaps if "above" in item]  # logs of earlier versions do not say
    totals = {"L_states": float(np.median([item["phi"] for item in told]))} if told else {}
    totals |= {"L_above": float(np.median([item["above"] for item in told]))} if told else {}
    return totals | {
        "gap": float(np.median(gamma)),
        "gap_p95": float(np.quantile(gamma, 0.95)),
        "unconverged": float(np.mean([item["converged"] == 0.0 for item in gaps])),
        "disagree": float(np.mean(spread > AGREEMENT)),
        "gap_spread": float(np.quantile(known, 0.95)) if len(known) else None,
        "gap_states": len(gaps),
    }


def _mean(frames: Sequence[Mapping[str, float]], key: str) -> float:
    return float(np.mean([frame.get(key, 0.0) for frame in frames]))


def model_name(model: str) -> str:
    """What weights are called, given by name or path: a run's ``model.safetensors`` by its folder."""
    path = Path(model)
    if path.suffix not in (".safetensors", ".pth"):
        return model
    return path.stem if path.stem != "model" else path.parent.name
