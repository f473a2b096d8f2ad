"""What ``plan=auto`` and ``accuracy=`` save in thirty scenes, and what is lost.

    python benchmarks/plan.py                                   # all scenes: frames of plan=full, plan=auto and accuracy=0.01
    python benchmarks/plan.py --scenes dress_plie outfit --frames 30
    python benchmarks/plan.py --accuracy none                   # plan=auto alone
    python benchmarks/plan.py --output outputs/plan.json        # the rows as a file too

A line per scene: milliseconds of the processor of a frame (solver, no metrics, no guard), the median over the frames of each
variant, the lower of two runs in turns; the share of the time that is saved; whether ``plan=auto`` gives the same bits;
of ``accuracy=`` the share of the steps that cost no more than that, and the worst: how much higher the full potential is after
them than after the step that the full model takes from the same state, as γ; steps that the full model took; seconds of
probing; what is left out. At the end the medians. (The full model's own steps do not always find the lowest minimum either:
``hood evaluate`` compares with several starts, this does not.)
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))  # the tests' own files of bodies and motions
import workshop

import hood
from hood.assets.garment.garment import load_garment
from hood.energies.potential import scale
from hood.energies.problem import StepProblem
from hood.evaluation.gap import StepSample
from hood.rollouts.loop import simulate
from hood.steppers.refined import prepare_stepper
from hood.studies.plan import plan as plan_auto

#: Frames of the motions and bodies that the tests' files hold here.
LONGEST = 90

#: Words of the scenes; FILE:METHOD:KIND is a file of :class:`workshop.Workshop`, TOP the vertices at the garment's upper end.
SCENES: dict[str, dict[str, Any]] = {
    "tank_plie": {"garment": "tank", "sequence": "plie"},
    "tank_walk": {"garment": "tank", "sequence": "walk_proud"},
    "tshirt_walk": {"garment": "tshirt", "sequence": "walk_proud"},
    "tshirt_dance": {"garment": "tshirt", "sequence": "dance_mixed"},
    "tshirt_denim": {"garment": "tshirt", "sequence": "wave_and_reach", "material": "denim"},
    "longsleeve_walk": {"garment": "longsleeve", "sequence": "walk_proud"},
    "longsleeve_reach": {"garment": "longsleeve", "sequence": "wave_and_reach"},
    "shorts_squats": {"garment": "shorts", "sequence": "squats"},
    "shorts_walk": {"garment": "shorts", "sequence": "walk_proud"},
    "trousers_plie": {"garment": "trousers", "sequence": "plie"},
    "trousers_walk": {"garment": "trousers", "sequence": "walk_proud"},
    "trousers_silk": {"garment": "trousers", "sequence": "dance_mixed", "material": "silk"},
    "skirt_twist": {"garment": "skirt", "sequence": "twist_and_bend"},
    "skirt_dance": {"garment": "skirt", "sequence": "dance_mixed"},
    "skirt_silk": {"garment": "skirt", "sequence": "plie", "material": "silk"},
    "skirt_60fps": {"garment": "skirt", "sequence": "walk_proud", "fps": 60},
    "dress_plie": {"garment": "dress", "sequence": "plie"},
    "dress_dance": {"garment": "dress", "sequence": "dance_mixed"},
    "dress_walk": {"garment": "dress", "sequence": "walk_proud"},
    "dress_jumps": {"garment": "dress", "sequence": "jumps"},
    "dress_denim": {"garment": "dress", "sequence": "walk_proud", "material": "denim"},
    "dress_silk": {"garment": "dress", "sequence": "dance_mixed", "material": "silk"},
    "dress_60fps": {"garment": "dress", "sequence": "dance_mixed", "fps": 60},
    "dress_120fps": {"garment": "dress", "sequence": "dance_mixed", "fps": 120},
    "dress_still_body": {"garment": "dress", "body": "FILE:body:still", "sequence": "none"},
    "dress_smpl_body": {"garment": "dress", "body": "FILE:body:smpl_npz", "sequence": "FILE:motion:amass_smplh"},
    "tshirt_gltf_body": {"garment": "FILE:garment:tshirt:posed", "body": "FILE:body:gltf_skin", "sequence": "none"},
    "skirt_no_body": {"garment": "skirt", "body": "none", "sequence": "none", "pins": "TOP"},
    "outfit_tank_skirt": {"garment": ["tank", "skirt"], "sequence": "plie"},
    "outfit_tshirt_trousers": {"garment": ["tshirt", "trousers"], "sequence": "walk_proud"},
}
#: What every rollout is.
ALWAYS = {"stepper": "newton", "metrics": "none", "guard": "off"}


def words_of(scene: str, files: workshop.Workshop, frames: int) -> dict[str, Any]:
    """The keys of a scene's rollout, its files written."""
    words = {key: _file(value, files) for key, value in SCENES[scene].items()}
    if words.get("pins") == "TOP":
        height = load_garment(words["garment"]).worn_pos[:, 1]
        words["pins"] = np.flatnonzero(height > height.max() - 5e-3).tolist()
    return {**words, **ALWAYS, "num_frames": frames}


def _file(value: Any, files: workshop.Workshop) -> Any:
    if not (isinstance(value, str) and value.startswith("FILE:")):
        return value
    method, *names = value.split(":")[1:]
    return getattr(files, method)(*names)


def run(words: dict[str, Any], sample: StepSample | None = None) -> tuple[float, np.ndarray, dict[str, np.ndarray], Any]:
    """Milliseconds of the processor of a frame, positions (T, V, 3) m, metrics of a plan (T,) each, and the simulation."""
    simulation = hood.simulate(**words)
    afresh = words.get("plan") == "full"
    rolled = simulate(
        simulation.stepper, simulation.scene, simulation.potential, len(simulation), observe=sample, metrics="none",
        settle="equilibrium", afresh=afresh,
    )  # fmt: skip
    spent, pos, told = [], [], []
    for frame, ms in _timed(rolled):
        pos.append(frame.world_pos)
        if frame.index > 1:
            spent.append(ms)
        told.append({name: frame.metrics[name] for name in ("plan_price", "plan_full") if name in frame.metrics})
    told = [row for row in told if row]
    figures = {name: np.array([row[name] for row in told]) for name in (told[0] if told else {})}
    return float(np.median(spent)), np.array(pos), figures, simulation


def _timed(frames: Iterator[Any]) -> Iterator[tuple[Any, float]]:
    while True:
        began = time.process_time()
        frame = next(frames, None)
        if frame is None:
            return
        yield frame, 1e3 * (time.process_time() - began)


def costs(sample: StepSample, whole: hood.Simulation) -> list[float]:
    """What the steps cost beyond those of the full model from the same states, as γ under its potential."""
    prepared, found = prepare_stepper(whole.stepper, whole.scene), []
    for problem, taken in sample.steps:
        fresh = StepProblem(problem.cloth, problem.state, problem.step, gravity=problem.gravity)
        known = whole.potential.prepare(whole.stepper.search(fresh))
        exact = whole.stepper.predict(known, prepared)
        here, there = (float(whole.potential.total(known, step.next_pos).double().sum()) for step in (taken, exact))
        found.append((here - there) / float(scale(known).sum()))
    return found


def measure(words: dict[str, Any], accuracy: float | None, plans: Path) -> dict[str, Any]:
    """Figures of a scene; its plan is kept in the folder ``plans``."""
    times: dict[str, list[float]] = {"full": [], "auto": [], "planned": []}
    full, auto = {**words, "plan": "full"}, {**words, "plan": "auto"}
    ms, pos, _, whole = run(full)
    times["full"].append(ms)
    ms, same, _, _ = run(auto)
    times["auto"].append(ms)
    row: dict[str, Any] = {"same_bits": bool(np.array_equal(pos, same)), "frames": len(pos)}
    if accuracy is not None:
        planned = {**words, "accuracy": accuracy}
        sample = StepSample(range(1, len(pos)), len(pos) - 1)
        with mock.patch.object(plan_auto, "cache_folder", return_value=plans):
            ms, _, told, _ = run(planned, sample)
            again, *_ = run(planned)
        times["planned"] += [ms, again]
        (plan,) = (json.loads(path.read_text(encoding="utf-8")) for path in plans.glob("plans/*.json"))
        left = [part["part"] for part in plan["rows"] if part["decision"] in ("left out", "taken")]
        row |= {"gamma": costs(sample, whole), "full_steps": float(told["plan_full"].mean()) if told else 0.0, "left_out": left}
        row |= {"probing": plan["seconds"], "limit": accuracy}
    times["auto"].append(run(auto)[0])
    times["full"].append(run(full)[0])
    return row | {f"ms_{name}": min(values) for name, values in times.items() if values}


#: Columns of a line: the heading, and the text of it.
COLUMNS: tuple[tuple[str, Any], ...] = (
    ("full", lambda row: f"{row['ms_full']:.1f}"),
    ("auto", lambda row: f"{row['ms_auto']:.1f}"),
    ("full/auto", lambda row: f"{row['ms_full'] / row['ms_auto']:.2f}"),
    ("bits", lambda row: "same" if row["same_bits"] else "OTHER"),
    ("planned", lambda row: f"{row['ms_planned']:.1f}"),
    ("full/planned", lambda row: f"{row['ms_full'] / row['ms_planned']:.2f}"),
    ("within", lambda row: f"{100 * np.mean(np.array(row['gamma']) <= row['limit']):.0f}%"),
    ("worst γ", lambda row: f"{max(row['gamma']):.2g}"),
    ("full steps", lambda row: f"{100 * row['full_steps']:.0f}%"),
    ("probing", lambda row: f"{row['probing']:.1f} s"),
)


def cells_of(row: dict[str, Any]) -> str:
    """The line of a scene; without a plan, what belongs to one is missing."""
    shown = COLUMNS if "gamma" in row else COLUMNS[:4]
    return "".join(f"{text(row):>13}" for _, text in shown) + "  " + ", ".join(row.get("left_out", ()))


def medians(rows: list[dict[str, Any]]) -> str:
    """Over the scenes."""
    auto = np.array([row["ms_full"] / row["ms_auto"] for row in rows])
    same = sum(row["same_bits"] for row in rows)
    text = f"plan=auto: the same bits in {same} of {len(rows)} scenes; full/auto {np.median(auto):.2f}, least {auto.min():.2f}"
    if all("gamma" in row for row in rows):
        planned = np.array([row["ms_full"] / row["ms_planned"] for row in rows])
        within = np.concatenate([np.array(row["gamma"]) <= row["limit"] for row in rows])
        text += f"\naccuracy={rows[0]['limit']:g}: full/planned {np.median(planned):.2f}, least {planned.min():.2f}; "
        text += f"{100 * within.mean():.1f}% of {len(within)} steps within it"
    return text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), metavar="SCENE", help=f"of {', '.join(SCENES)}")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--accuracy", default="0.01", help="as of hood rollout; none: plan=auto alone")
    parser.add_argument("--output", type=Path, help="JSON file of the rows")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.scenes if name not in SCENES]
    if unknown:
        parser.error(f"no scene {unknown[0]!r}; choose of {', '.join(SCENES)}")
    accuracy = None if arguments.accuracy == "none" else float(arguments.accuracy)
    rows: dict[str, dict[str, Any]] = {}
    print(f"{'scene':24}" + "".join(f"{head:>13}" for head, _ in COLUMNS) + "  left out")
    with tempfile.TemporaryDirectory() as folder, mock.patch.object(workshop, "COUNT", LONGEST), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what scenes say of themselves
        files = workshop.Workshop(Path(folder))
        for scene in arguments.scenes:
            words = words_of(scene, files, arguments.frames)
            row = rows[scene] = measure(words, accuracy, Path(folder) / scene)
            print(f"{scene:24}{cells_of(row)}", flush=True)
    print(medians(list(rows.values())))
    if arguments.output is not None:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        arguments.output.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
