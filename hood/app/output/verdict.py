"""The verdict of a rollout (sound or unsound, and what is doubtful): in its summary, on the screen, as exit code.

What the exit codes mean: one table, for the commands and for the help.

What a rollout's file says about the cloth's surface: skin through cloth and cloth through cloth, in numbers and in words.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from hood.limits import CUT_UNSOUND, STRAIN_UNSOUND
from hood.media.pieces import pieces_by
from hood.mesh.penetration.crossing import crossings, self_crossings
from hood.mesh.topology import connected_components, unique_edges
from hood.rollouts.file.reader import RolloutData
from hood.rollouts.verdict.causes import CROSSING_KINDS
from hood.rollouts.verdict.frames import mask_of, runs_of, worst_frame
from hood.rollouts.verdict.rule import Verdict, judge_rollout, stored_doubts
from hood.rollouts.verdict.surface import Meshes, in_folds, meshes_of

#: A rollout that ran to its end and cannot be trusted.
UNSOUND = 3
#: A frame with a larger share of cut triangles is warned about.
WORST_CUT = CUT_UNSOUND.value


def summarise_surface(metrics: Mapping[str, np.ndarray], stride: int | None) -> dict[str, Any] | None:
    """Means and worst frames of :data:`hood.rollouts.verdict.surface.SURFACE_METRICS` by frame (T,); None where none was
    measured."""
    share = metrics.get("cut_face_share", np.empty(0))
    measured = int(np.isfinite(share).sum())
    if measured == 0:
        return None
    folds = metrics.get("cut_in_folds")  # older files have none
    apart = {} if folds is None else {"cut_apart_from_folds": _mean_and_worst(share - folds)}
    return {
        "stride": stride,
        "frames_measured": measured,
        "cut_face_share": _mean_and_worst(share),
        **apart,
        "cut_edge_share": _mean_and_worst(metrics["cut_edge_share"]),
        "skin_depth_m": _mean_and_worst(metrics["skin_depth"]),
        "self_crossings": _mean_and_worst(metrics["self_crossings"]),
        "garment_crossings": _mean_and_worst(metrics["garment_crossings"]),
    }


def describe_surface(surface: Mapping[str, Any] | None) -> list[str]:
    """A line on what was found, none where nothing was measured, and a warning for each thing that pictures show."""
    if surface is None:
        return []
    cut, depth, stride = surface["cut_face_share"], surface["skin_depth_m"], surface["stride"]
    every = "" if stride is None else " (every frame)" if stride == 1 else f" (one frame in {stride}, first and last)"
    crossed = [
        f"{surface[key]['mean']:.1f} pairs of triangles of {what} pass through each other on average"
        for key, what in (("self_crossings", "one garment"), ("garment_crossings", "two garments"))
        if surface[key]["worst"] > 0
    ]
    found = [
        f"the body cuts {cut['mean']:.1%} of the cloth's triangles on average, {cut['worst']:.1%} in frame {cut['frame']}"
        + _apart_from_folds(surface),
        f"skin at most {1e3 * depth['worst']:.1f} mm above the cloth",
        *crossed,
    ]
    return [f"surface{every}: {', '.join(found)}", *surface_warnings(surface)]


def _apart_from_folds(surface: Mapping[str, Any]) -> str:
    """What is left without the triangles that are caught where the body passes through itself; empty without such."""
    rest = surface.get("cut_apart_from_folds")
    if rest is None or rest["mean"] == surface["cut_face_share"]["mean"]:
        return ""
    return f" ({rest['mean']:.2%} and {rest['worst']:.2%} apart from where the body passes through itself)"


def cut_at_worst(surface: Mapping[str, Any] | None) -> str:
    """The worst frame in a few words, for a line among many."""
    return "skin through cloth n/a" if surface is None else f"skin cuts {surface['cut_face_share']['worst']:.1%} at worst"


def surface_warnings(surface: Mapping[str, Any]) -> list[str]:
    cut, lines = surface["cut_face_share"], []
    if cut["worst"] > WORST_CUT:
        lines.append(
            f"warning: the body's skin cuts {cut['worst']:.1%} of the cloth's triangles in frame {cut['frame']}; "
            "the verdict counts what a viewer sees of it"
        )
    for key, what in (("self_crossings", "the cloth"), ("garment_crossings", "two garments")):
        worst = surface[key]
        if worst["worst"] > 0:
            lines.append(
                f"warning: {worst['worst']:.0f} pairs of triangles of {what} pass through each other in frame {worst['frame']}"
            )
    return lines


def _mean_and_worst(values: np.ndarray) -> dict[str, Any]:
    """Over the measured ones of the frames; the first of equally bad frames is named."""
    worst = int(np.nanargmax(values))
    return {"mean": float(np.nanmean(values)), "worst": float(values[worst]), "frame": worst}


#: Metrics of which the worst frame is named beside the median.
_WORST = ("strain_p99", "distance_p99", "relative_gradient")
#: What ends with exit code 3; doubts are what ends so beside unsound results.
FAIL_ON = FAIL_ON_UNSOUND, FAIL_ON_DOUBTS, FAIL_ON_NOTHING = "unsound", "doubts", "nothing"


def summarise_verdict(data: RolloutData) -> dict[str, Any]:
    """Entries ``sound`` (None: not known), ``reasons`` and ``unsound_reasons`` (their sentences; what is missing, where not
    known), ``doubts``, ``faults``, ``notes`` and ``worst_frames``: docs/verdict.md has them as a schema."""
    verdict = judge_rollout(data)
    worst = {name: worst_frame(data.step_metrics[name]) for name in _WORST if name in data.step_metrics}
    return {
        "sound": verdict.sound,
        "reasons": [reason.as_dict() for reason in verdict.reasons],
        "unsound_reasons": list(verdict.sentences),
        "doubts": list(verdict.doubts),
        "faults": find_faults(data, verdict),
        "notes": list(verdict.notes),
        "worst_frames": {name: {"value": found[0], "frame": found[1]} for name, found in worst.items() if found is not None},
    }


#: Numbers of vertices or triangles that a fault names, at most.
_NAMED = 200


def find_faults(data: RolloutData, verdict: Verdict) -> list[dict[str, Any]]:
    """Entry ``faults``: where the cloth is what makes the ``verdict`` unsound or doubtful, of every kind and garment.

    ``first_frame`` and ``frames`` (runs, first and last) are as in the reasons. ``vertices`` or ``triangles`` are those of the
    first of these frames that is stored, in numbers of the garment by itself, as its file and every export have them;
    :data:`_NAMED` at most, and none of what is not known of single ones.
    """
    told = [(one.kind, one.frames, one.sentence, one.part) for one in verdict.reasons] if verdict.sound is False else []
    for doubt in verdict.doubts[len(stored_doubts(data)) :]:
        runs = tuple(runs_of(mask_of(doubt["frames"]))) if doubt["frames"] else ()
        crossed = (kind for kind, what in CROSSING_KINDS.values() if f"triangles of {what} pass" in doubt["sentence"])
        told.append((next(crossed, doubt["kind"]), runs, doubt["sentence"], None))
    meshes = meshes_of(data)
    title, count = str(data.attributes.get("garment", "cloth")), meshes.cloth.shape[1]
    pieces = pieces_by(title, count, meshes.faces, {} if meshes.piece is None else {"piece": meshes.piece})
    found: list[dict[str, Any]] = []
    for kind, runs, sentence, part in told:
        if not runs:
            continue
        fault = {"kind": kind, "garment": title, "first_frame": runs[0][0], "frames": [list(run) for run in runs]}
        fix = sentence.partition("; ")[2] or None
        stored = next((place for place, step in enumerate(meshes.step) if any(a <= step <= b for a, b in runs)), None)
        what, numbers = ("vertices", np.zeros(0, np.int64)) if stored is None else _place(kind, data, meshes, stored, part)
        if what == "triangles" and data.refined is not None:  # what is stored has other triangles
            what, numbers = "vertices", np.unique(meshes.faces[numbers])
        parts = [(piece.name, piece.vertices if what == "vertices" else piece.faces) for piece in pieces]
        rows = [(name, np.searchsorted(own, numbers[np.isin(numbers, own)])[:_NAMED].tolist()) for name, own in parts]
        named = [{**fault, "garment": name, what: own, "fix": fix} for name, own in rows if own]
        found += named or [{**fault, "fix": fix}]
    return found


def _place(kind: str, data: RolloutData, meshes: Meshes, frame: int, part: int | None) -> tuple[str, np.ndarray]:
    """``vertices`` or ``triangles``, and those that a fault of this kind is at in a stored frame; none where nobody knows."""
    pos, body = meshes.cloth[frame].astype(np.float64), meshes.body[frame].astype(np.float64)
    finite, faces = np.isfinite(pos).all(axis=1), meshes.faces
    if kind == "not_finite":
        return "vertices", np.flatnonzero(~finite)
    if kind == "not_worn":
        label = connected_components(len(pos), unique_edges(faces))
        used = np.unique(faces)
        return "vertices", used if part is None else used[label[used] == np.unique(label[used])[part - 1]]
    if kind in ("distance", "solver_target", "gradient"):
        force = np.nan_to_num(data.fields["rg"][frame, : len(pos)]) if "rg" in data.fields else np.zeros(len(pos))
        order = np.argsort(-force, kind="stable")[:_NAMED]
        return "vertices", order[force[order] > 0]
    if not (finite.all() and np.isfinite(body).all()):
        return "vertices", np.zeros(0, np.int64)
    if kind == "strain":
        edges = unique_edges(faces)
        length = np.linalg.norm(pos[edges[:, 1]] - pos[edges[:, 0]], axis=1)
        off = np.abs(length / meshes.rest_length - 1.0)
        order = np.argsort(-off, kind="stable")
        ends = edges[order[off[order] > STRAIN_UNSOUND.value]].reshape(-1)
        return "vertices", ends[np.sort(np.unique(ends, return_index=True)[1])]
    if kind in ("cloth_through_cloth", "garments_through_each_other"):
        pairs = self_crossings(pos, faces)
        piece = np.zeros(len(pos), np.int64) if meshes.piece is None else meshes.piece
        same = piece[faces[pairs[:, 0], 0]] == piece[faces[pairs[:, 1], 0]]
        return "triangles", np.unique(pairs[same == (kind == "cloth_through_cloth")])
    if kind in ("skin_through_cloth", "skin_depth", "inside_body"):
        pairs = crossings(pos, faces, body, meshes.body_faces).pairs
        return "triangles", np.unique(pairs[~in_folds(pairs[:, 1], body, meshes.body_faces), 0])
    return "vertices", np.zeros(0, np.int64)


def describe_worst(summary: Mapping[str, Any], metric: str, form: str) -> str:
    """`` (worst 12.1% in frame 7)`` for the text behind a median; empty where nothing was measured."""
    found = summary["worst_frames"].get(metric)
    return "" if found is None else f" (worst {format(found['value'], form)} in frame {found['frame']})"


def describe_verdict(summary: Mapping[str, Any]) -> list[str]:
    """How far the steps were taken, what does not count, doubts, and the verdict with its reasons, a line each."""
    lines = [*_describe_distance(summary), *(f"not counted: {note}" for note in summary["notes"])]
    lines += [f"doubt: {doubt['sentence']}" for doubt in summary["doubts"]]
    reasons = summary["unsound_reasons"]
    if summary["sound"] is None:
        return [*lines, *(f"not judged: {reason}" for reason in reasons)]
    doubtful = f", with {_count(len(summary['doubts']), 'doubt')}" if summary["doubts"] else ""
    return [*lines, *(f"UNSOUND: {reason}" for reason in reasons)] if reasons else [*lines, f"sound{doubtful}"]


def _describe_distance(summary: Mapping[str, Any]) -> list[str]:
    """In millimetres where that was measured; else by the force that is left."""
    distance = summary["distance_p99_median_m"]
    if distance is not None:
        worst = summary["worst_frames"]["distance_p99"]
        return [
            f"distance to the minimum of a step (p99): {1e3 * distance:.2g} mm (worst {1e3 * worst['value']:.2g} mm in frame "
            f"{worst['frame']})"
        ]
    if summary["relative_gradient_median"] is None:
        return []
    worst_text = describe_worst(summary, "relative_gradient", ".2g")
    return [f"relative gradient {summary['relative_gradient_median']:.2g}{worst_text}"]


def exit_code(summaries: Iterable[Mapping[str, Any]], fail_on: str = FAIL_ON_UNSOUND) -> tuple[int, list[str]]:
    """3 where a guard has ended one of the rollouts, or one is what ``fail_on`` says, one of :data:`FAIL_ON`; and the sentences
    that say so."""
    summaries = list(summaries)
    if any((summary.get("guard") or {}).get("stopped") is not None for summary in summaries):
        return UNSOUND, []
    said: list[str] = []
    unsound = sum(summary.get("sound") is False for summary in summaries)
    doubtful = sum(bool(summary.get("doubts")) for summary in summaries) if fail_on == FAIL_ON_DOUBTS else 0
    if unsound and fail_on == FAIL_ON_NOTHING:
        said.append(f"{_are(unsound)} unsound, which fail_on=nothing allows")
        unsound = 0
    if unsound:
        said.append(f"{_are(unsound)} unsound; its files are kept, exit code {UNSOUND} (0 with fail_on=nothing)")
    if doubtful:
        said.append(f"{_are(doubtful)} doubtful; exit code {UNSOUND}, as fail_on=doubts asks")
    return UNSOUND if unsound or doubtful else 0, said


def _are(count: int) -> str:
    return "the rollout is" if count == 1 else f"{count} rollouts are"


def _count(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
