"""``hood plan``: what a scene needs of the model, what each part costs, and what would be lost without it.

``plan=5mm``: a rollout that plans first. Plans are kept by scene, settings and processor.

How far a step is felt in a cloth, how wide its mesh is, and which shipped networks reach as far.

What the page of ``hood plan`` shows besides its table: facts of the mesh, and the cloth with and without parts.
"""

from __future__ import annotations

import hashlib
import json
import math
import shlex
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from hood import __version__
from hood.app.common import held_folder, output_folder
from hood.app.notices import say
from hood.app.plan_file import FREE, content_digest, key_of, plan_accuracy, read_plan, write_plan
from hood.app.settings.compose import ConfigError, load_config, named_today, plain, with_words
from hood.app.settings.overrides import plain_word
from hood.app.settings.rollout_settings import RolloutSettings, fixed_shapes
from hood.app.settings.rollout_settings import overrides as overrides_of
from hood.app.setup import Setup, check_config, make_stepper, set_up
from hood.app.stepping.cloth_contact import acts, why_not
from hood.assets.files.library import locate, names
from hood.cloth.cloth import Cloth
from hood.model.graph.builder import edge_set_names, parse_schedule, radius
from hood.model.graph.hierarchy import num_passed_over
from hood.native.build import cache_folder, processor
from hood.steppers.checkpoint import CAUTION, read_header
from hood.steppers.static_shapes.simulator import network_of
from hood.studies.plan.ablation import LEAD, Begun, Effect
from hood.studies.plan.choices import levels_of
from hood.studies.plan.decide import QUANTILE, Combination, Tolerance
from hood.studies.plan.discretisation import Apart
from hood.studies.plan.page import SHOWN, Difference, describe_plan, plan_command, sentence, write_plan_page
from hood.studies.plan.probe import HOLD, AskedOf, Probed, probe

#: Words of these keys belong to a training, and to no rollout.
_TRAINING_GROUPS = ("experiment", "trainer", "data")
#: Steps of a window by default, where γ of single steps decides, and where lengths do.
_BRIEF, _LONG = 3, 30
#: Keys of ``hood plan`` that the plan of a training has, beside its folder.
_TRAINING_KEYS = ("updates", "scenes")


def run(overrides: Sequence[str]) -> int:
    """Run the command, for a rollout or for a training; returns the exit code."""
    own, words = _split(overrides)
    given = [word for word in overrides if word not in words]
    if is_training(words):
        return _run_training(own, words, given)
    _refuse(given, _TRAINING_KEYS, "belongs to the plan of a training (with experiment=, trainer= or data.*=)")
    _check(words, own)
    output_folder(own)
    with held_folder(own) as folder:
        plan, shown = make_plan(words, own)
        write_plan(folder / "plan.json", plan)
        page = show(folder / "plan.html", plan, sentence(plan), shown)
    print(describe_plan(plan))
    print(reach_sentence(plan["facts"]))
    print(page)
    print(f"measured in {plan['cpu_seconds']:.1f} s of the processor")
    file = str(folder / "plan.json")
    again = shlex.join(["hood", "rollout", plain_word("plan", file), "output=outputs/mine"])
    print(f"plan in {file}; roll out by it: {again}")
    watched = "" if plan["watch"] is None else " (what is left out does not come back where it matters; by the plan it does)"
    print(f"the same in words{watched}: {plan['command']}")
    return 0


def _run_training(own: DictConfig, words: list[str], given: Sequence[str]) -> int:
    """The plan of a training."""
    from hood.studies.plan.training import (  # not for rollouts
        checked_training,
        describe_training,
        plan_training,
        write_training_plan,
    )

    others = [str(key) for key in own if key not in ("output", *_TRAINING_KEYS)]
    _refuse(given, others, "belongs to the plan of a rollout")
    config = checked_training(words, own)
    output_folder(own)
    with held_folder(own) as folder:
        plan = plan_training(config, words, int(own.updates), int(own.scenes))
        path = write_training_plan(folder, plan)
    print(describe_training(plan))
    print(f"all of it in {path}")
    return 0


def is_training(words: Sequence[str]) -> bool:
    """Whether these are words of ``hood train``."""
    return any(word.partition("=")[0].partition(".")[0].lstrip("+~") in _TRAINING_GROUPS for word in words)


def _refuse(given: Sequence[str], keys: Sequence[str], why: str) -> None:
    for word in given:
        if key_of(word) in keys:
            raise ConfigError(f"{word}: {why}; drop it")


def make_plan(words: list[str], own: DictConfig, evidence: bool = True) -> tuple[dict[str, Any], list[Difference]]:
    """The plan of a rollout with these words, measured here, and the largest differences that were seen.

    Args:
        own: the config of ``hood plan``.
        evidence: whether other meshes and time steps are looked at, and parts that are kept whatever they are worth; without,
            parts alone are left out, in half the time.

    Raises:
        ConfigError, ValueError, FileNotFoundError: as for a rollout, and numbers of ``own`` that are none.
    """
    config, tolerance, budget = _check(words, own)
    began, spent = time.perf_counter(), time.process_time()
    if not fixed_shapes(config):  # what is compared with this one has other shapes
        config = config.with_values(step="plain")
    ready = set_up(config, make_stepper(config)[0])
    frames = _frames(own, tolerance, budget, min(int(ready.config.num_frames), ready.scene.num_frames))
    asked = AskedOf(tolerance, budget, [str(name) for name in own.parts], int(own.windows), frames, evidence=evidence)
    found = probe(ready, asked)
    plan = _record(ready, [*words, *_settled_words(config, ready)], asked, found)
    shown = differences(ready, found.begun, found.effects, asked.frames) if evidence else []
    plan |= {"asked": words, "facts": facts(ready) if evidence else {}, "seconds": time.perf_counter() - began}
    return plan | {"cpu_seconds": time.process_time() - spent}, shown


def _check(words: list[str], own: DictConfig) -> tuple[RolloutSettings, Tolerance, float | None]:
    """The rollout's config, what is accepted and how long a frame may take, before anything is read."""
    config = RolloutSettings.from_words(words)
    check_config(config)
    for key, least, most in (("windows", 1, 5), ("frames", 1, 300)):
        if own[key] is None and key == "frames":
            continue
        if isinstance(own[key], bool) or not isinstance(own[key], int) or not least <= own[key] <= most:
            raise ConfigError(f"{key}={own[key]}: give a whole number from {least} to {most}")
    budget = own.budget_ms
    if budget is not None and (isinstance(budget, bool) or not isinstance(budget, (int, float)) or not 0 < budget < math.inf):
        raise ConfigError(f"budget_ms={budget}: give milliseconds of a frame, above 0 (budget_ms=10)")
    return config, _tolerance(own), None if budget is None else float(budget)


def _frames(own: DictConfig, tolerance: Tolerance, budget: float | None, num_frames: int) -> int:
    """Steps of a window: those that are asked for, else a few where single steps are judged by γ, and a second of them where
    lengths are, as far as the motion goes."""
    if own.frames is not None:
        return int(own.frames)
    if tolerance.unit == "gamma" and budget is None:
        return _BRIEF
    return max(min(_LONG, num_frames - LEAD - 2), 1)


def _split(overrides: Sequence[str]) -> tuple[DictConfig, list[str]]:
    """The plan's own config, and the words of the rollout."""
    own = {str(key) for key in load_config("plan")}
    mine = [word for word in overrides if key_of(word) in own]
    words = [word for word in overrides if word not in mine]
    if any(key_of(word) == "plan" for word in words):
        raise ConfigError("plan=…: a plan is made of the full model; drop plan=…")
    return load_config("plan", mine), words if is_training(words) else list(named_today(words))


def _tolerance(own: DictConfig) -> Tolerance:
    try:
        return Tolerance.read(str(own.accuracy))
    except ValueError as error:
        raise ConfigError(str(error)) from error


def _settled_words(asked: RolloutSettings, ready: Setup) -> list[str]:
    """What ``auto`` became."""
    alone = str(ready.config.stepper) == "newton"
    keys = [key for key in ("stepper", "refine") if asked[key] != ready.config[key] and not (alone and key == "refine")]
    return overrides_of({key: plain(ready.config[key]) for key in keys})


def _record(ready: Setup, words: list[str], asked: AskedOf, found: Probed) -> dict[str, Any]:
    full, begun, tolerance = found.effects[""], found.begun, asked.tolerance
    rows: list[dict[str, Any]] = []
    for part in found.parts:
        row = {"part": part.name, "purpose": part.purpose, "words": list(part.words), "force": found.price.get(part.term)}
        rows.append(row | (_numbers(found.effects[part.name], full) if part.name in found.effects else {}))
    for one in found.choices:
        row = {"part": one.name, "kind": one.kind, "purpose": one.purpose, "words": list(one.words), "force": None}
        rows.append(row | _numbers_apart(found.apart[one.name], one.pace, found.full_ms, float(ready.config.fps)))
    for row in rows:
        verdict = found.verdicts[str(row["part"])]
        how = [f"parts=[{row['part']}]", f"frames={asked.frames}", f"windows={len(begun)}", f"accuracy={tolerance.text}"]
        how += [] if asked.budget_ms is None else [f"budget_ms={asked.budget_ms:g}"]
        row |= {"decision": verdict.decision, "reason": verdict.reason, "command": shlex.join(["hood", "plan", *words, *how])}
    checkpoint = str(ready.config.checkpoint)
    network = network_of(ready.stepper) is not None and checkpoint != "untrained"
    together = None
    if found.together is not None:
        together = _numbers(found.together, full) | {"error": tolerance.error(found.together, full)}
    return {
        "words": words,
        "content": content_digest(words),
        "chosen": found.words,
        "command": plan_command(words, found.words),
        "accuracy": {"value": tolerance.value, "unit": tolerance.unit},
        "budget_ms": asked.budget_ms,
        "windows": [{"first": one.window.first, "measured_from": one.frame, "reason": one.window.reason} for one in begun],
        "frames": asked.frames,
        "full": _numbers(full, full),
        "times": _times(begun, full.median_ms),
        "windows_without_minimum": full.exact.count(False),
        "rows": rows,
        "together": together,
        "combination": None if found.search is None else _combined(found),
        "watch": None if found.limit is None else {"limit": found.limit, "hold": HOLD},
        "weights": hashlib.sha256(locate("weights", checkpoint).read_bytes()).hexdigest() if network else None,
    }


def _times(begun: Sequence[Begun], frame_ms: float) -> dict[str, float]:
    """Milliseconds of the parts of a frame of the full model, the longest first: their shares, the medians of the windows, of
    ``frame_ms``, which may be of another clock."""
    names = [name for name in begun[0].times if name not in ("total", "metrics", "layers")]  # layers are a part of the solver
    found = {name: float(np.median([one.times[name] for one in begun])) for name in names}
    whole = sum(found.values())
    return {name: ms / whole * frame_ms for name, ms in sorted(found.items(), key=lambda pair: -pair[1]) if whole > 0.0}


def _combined(found: Probed) -> dict[str, Any]:
    """What the search for a combination found, and what it tried."""
    assert found.search is not None

    def told(one: Combination) -> dict[str, Any]:
        return {"names": list(one.names), "mm_p50": _finite(one.half_mm), "mm": _finite(one.mm), "ms": one.ms}

    tried = [told(one) for one in found.search.tried]
    return told(found.search.chosen) | {"fits": found.search.fits, "full_ms": found.full_ms, "tried": tried}


def _numbers(effect: Effect, full: Effect) -> dict[str, float | None]:
    found = {
        "gamma_p50": effect.gamma_at(0.5),
        "gamma_p95": effect.gamma_at(QUANTILE),
        "mm_p50": max(effect.half_mm),
        "mm": effect.worst_mm,
        "ms": effect.median_ms,
        "saved": effect.saving(full),
        "windows": len(effect.gamma),
    }
    return {key: _finite(value) for key, value in found.items()}


def _numbers_apart(apart: Apart, pace: float, full_ms: float, fps: float) -> dict[str, float | None]:
    """Of another mesh or time step; ``ms`` is of a frame of the full model, whatever the steps in it."""
    ms = apart.frame_ms(pace)
    found = {
        "mm_p50": max(apart.half_mm),
        "mm": max(apart.mm),
        "ms": ms,
        "ms_per_second": ms * fps,
        "saved": 1.0 - ms / full_ms,
        "windows": len(apart.mm),
    }
    return {key: _finite(value) for key, value in found.items()}


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def planned(overrides: Sequence[str]) -> list[str]:
    """The words of a rollout; where ``plan`` is an accuracy its plan is made, or found where it was kept, and stands in them.

    A plan lies in the user's cache folder, or beside the rollout where nothing may be kept.

    Raises:
        ConfigError: an accuracy of no use, and what ``hood plan`` refuses.
    """
    overrides = named_today(overrides)
    config = RolloutSettings.from_words(overrides)
    accuracy = plan_accuracy(config)
    if accuracy is None:
        return list(overrides)
    words = [word for word in overrides if key_of(word) not in ("plan", *FREE) or key_of(word) == "num_frames"]
    Tolerance.read(accuracy, "plan")
    own = with_words(load_config("plan"), [f"accuracy={accuracy}"])
    cache = cache_folder()
    path = (output_folder(config) if cache is None else cache / "plans") / f"plan-{_digest(words, accuracy)}.json"
    if path.is_file():
        plan = read_plan(path)
        say(f"plan of {path}, made before")
    else:
        plan, _ = make_plan(words, own, evidence=False)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_plan(path, plan)
        say(f"planned in {plan['seconds']:.1f} s, kept in {path}")
    say(sentence(plan))
    return [*(word for word in overrides if key_of(word) in FREE), f"plan='{path}'"]  # the others stand in it


def _digest(words: Sequence[str], accuracy: str) -> str:
    """Of everything that a plan depends on, the processor that its times are of among it."""
    said = [__version__, processor(), accuracy, str(load_config("rollout", words).stepper), content_digest(words)]
    return hashlib.sha256("\0".join(said).encode()).hexdigest()[:24]


#: Nine tenths of what a push does in one step is felt within so many times the way of a wave.
_FELT = 2.9


def reach_facts(cloth: Cloth, dt: float) -> dict[str, Any]:
    """Of a cloth and a step [s]: numbers that say how far a network has to pass messages on, and which shipped ones do.

    ``wave_speed`` [m/s]; ``influence_edges``, 2.9 c dt in mean edges; ``diameter_edges`` of the mesh; ``needed_edges``, the
    smaller of the two; ``models``, of every shipped network its schedule's radius in edges, its coarse levels, and whether
    the radius suffices.
    """
    speed = wave_speed(cloth)
    influence, wide = _FELT * speed * dt / cloth.mean_edge, diameter(cloth)
    needed = min(influence, float(wide))
    return {
        "wave_speed": speed,
        "influence_edges": influence,
        "diameter_edges": wide,
        "needed_edges": needed,
        "models": [one | {"suffices": one["radius"] >= needed} for one in _shipped(cloth.mean_edge)],
    }


def wave_speed(cloth: Cloth) -> float:
    """Speed [m/s] of waves in the plane of the cloth, √((λ + 2 μ) h / ρ), of its mean fabric along the stiffer thread."""
    stiffness = (cloth.lame_lambda + 2.0 * cloth.lame_mu) * cloth.thickness
    if cloth.weave is not None:
        stiffness = stiffness * cloth.weave[:, :2].amax(dim=1)
    density = cloth.mass.sum() / cloth.rest_area.sum()
    return float((torch.as_tensor(stiffness).double().mean() / density.double()).sqrt())


def diameter(cloth: Cloth) -> int:
    """Edges from one end of the mesh to the other, of its widest piece: from the vertex that is farthest from any, the way to
    the farthest. No two vertices are farther apart than twice that."""
    first, second = cloth.edges.cpu().numpy().T
    graph = coo_matrix((np.ones(len(first)), (first, second)), shape=(cloth.num_vertices,) * 2).tocsr()
    widest, left = 0.0, np.ones(cloth.num_vertices, dtype=bool)
    while left.any():
        start = int(np.flatnonzero(left)[0])
        for _ in range(2):
            steps = dijkstra(graph, directed=False, indices=start, unweighted=True)
            there = np.isfinite(steps)
            start = int(np.where(there, steps, -1.0).argmax())
        widest, left = max(widest, float(steps[there].max())), left & ~there
    return int(widest)


def _shipped(edge: float) -> list[dict[str, Any]]:
    """Name, radius in edges and number of coarse levels of every shipped network that no one is warned of, on a mesh of this
    mean edge [m]."""
    found = []
    for name in names("weights"):
        header = read_header(locate("weights", name))
        if CAUTION in header:
            continue
        model = json.loads(header["model"])
        schedule, passed_over = parse_schedule(str(model["schedule"])), num_passed_over(edge, model.get("coarse_edge"))
        found.append({"name": name, "radius": radius(schedule, passed_over), "levels": len(edge_set_names(schedule)) - 1})
    return sorted(found, key=lambda one: (one["radius"], one["name"]))


def reach_sentence(facts: dict[str, Any]) -> str:
    """The evidence in a sentence."""
    enough = [f"{one['name']} ({one['radius']})" for one in facts["models"] if one["suffices"]]
    short = [f"{one['name']} ({one['radius']})" for one in facts["models"] if not one["suffices"]]
    return (
        f"hierarchy: in one step a push is felt {facts['influence_edges']:.0f} edges away (2.9 c dt, c = "
        f"{facts['wave_speed']:.0f} m/s), the mesh is {facts['diameter_edges']} edges wide, so messages have to pass "
        f"{facts['needed_edges']:.0f} edges; schedules that do: {', '.join(enough) or 'none'}; that do not: "
        f"{', '.join(short) or 'none'}"
    )


def facts(ready: Setup) -> dict[str, Any]:
    """Of the mesh, its fabric and the network: numbers that say what they can show."""
    cloth, network, garment = ready.scene.cloth, network_of(ready.stepper), str(ready.config.garment)
    levels = list(levels_of(garment))
    return {
        "vertices": cloth.num_vertices,
        "edge_mm": 1e3 * cloth.mean_edge,
        **reach_facts(cloth, ready.scene.dt),
        "network": None if network is None else str(ready.config.checkpoint),
        "levels": None if network is None else network.num_coarse,
        "no_cloth_contact": _why_no_contact(ready),
        "finer": levels[levels.index(garment) + 1 :] if levels else [],
    }


def _why_no_contact(ready: Setup) -> str | None:
    """Why layers of cloth are not kept apart in this rollout; None where they are."""
    if acts(ready.config):
        return None
    return why_not(ready.config) or "cloth_contact=off was asked for"


def differences(ready: Setup, begun: Sequence[Begun], effects: Mapping[str, Effect], frames: int) -> list[Difference]:
    """The largest ones of all parts, each in its worst window."""
    found, scene = [], ready.scene
    for name, effect in effects.items():
        finite = [mm if np.isfinite(mm) else -1.0 for mm in effect.mm]
        worst = int(np.argmax(finite))
        if not name or finite[worst] <= 0.0:
            continue
        frame = begun[worst].frame + frames
        origin = np.asarray(scene.motion.translation[frame], dtype=np.float64)
        body = scene.motion.surface(frame, origin).cpu().double().numpy() + origin
        full, without = (one.last[worst].numpy() for one in (effects[""], effect))
        surfaces = full, without, scene.garment.faces, body, scene.motion.faces
        found.append(Difference(name, frame, finite[worst], *surfaces))
    return sorted(found, key=lambda one: -one.mm)[:SHOWN]


def show(path: Path, plan: Mapping[str, Any], sentence: str, shown: Sequence[Difference]) -> str:
    """Write the page; a line on it. Without the picture libraries it has no pictures."""
    try:
        write_plan_page(path, plan, sentence, shown)
    except ImportError as error:
        write_plan_page(path, plan, sentence, [])
        return f"page in {path}, without pictures: {error}"
    return f"page in {path}"
