"""``hood inspect FILE …``: what files are, what is wrong with them, how to repair it, and whether they fit together."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from omegaconf import DictConfig

from hood.assets import identify as kinds
from hood.assets.animated_mesh import body_kind
from hood.assets.body import load_body
from hood.commands import findings
from hood.commands.findings import Finding
from hood.commands.wardrobe import read_outfit
from hood.config import ConfigError, load_config, require_choice
from hood.scene.cast import MotionOptions, load_motion
from hood.scene.fitting import fit_figures
from hood.scene.scene import dress

_KEYS = ("body", "up", "fps", "format")
#: A start beyond these does not fit: edges stretched by this share, vertices this deep [m].
_STRETCH_LIMIT, _DEPTH_LIMIT = 0.10, 2e-3


def run(arguments: Sequence[str]) -> int:
    """Run the command; returns the exit code: 0 where nothing needs repair, 1 where something does."""
    files, config = _split(arguments)
    require_choice(config, "format", ("text", "json"))
    found = [_inspect(name, config) for name in files]
    fit = _fit(found, config)
    report = {"files": [_as_dict(finding) for finding in found], "fit": fit}
    print(json.dumps(report, indent=1) if str(config.format) == "json" else _text(found, fit))
    sound = all(not finding.problems for finding in found) and (fit is None or fit["fits"])
    return 0 if sound else 1


def _split(arguments: Sequence[str]) -> tuple[list[str], DictConfig]:
    """Files and the config: a word ``key=value`` is an override, every other word a file."""
    words = ["format=json" if word == "--json" else word for word in arguments]
    overrides = [word for word in words if word.split("=")[0] in _KEYS and "=" in word]
    files = [word for word in words if word not in overrides]
    if not files:
        raise ConfigError("no file is given: hood inspect shirt.obj walk.npz")
    if any(word.startswith("-") for word in files):
        raise ConfigError(
            f"unknown option {next(w for w in files if w.startswith('-'))!r}; known are --json, {', '.join(_KEYS)}"
        )
    return files, load_config("inspect", overrides)


def _inspect(name: str, config: DictConfig) -> Finding:
    kind = kinds.identify(name)
    if kind == kinds.GARMENT:
        body = str(config.body)
        return findings.inspect_garment(name, load_body(body if body_kind(body) == "model" else "default"))
    if kind == kinds.MOVING_MESH:
        return findings.inspect_moving_mesh(name, float(config.fps))
    if kind == kinds.REFERENCE_ROLLOUT:
        return findings.inspect_pickle(name, kind)
    readers = {
        kinds.BODY: findings.inspect_body,
        kinds.MOTION: findings.inspect_motion,
        kinds.CHECKPOINT: findings.inspect_checkpoint,
        kinds.ROLLOUT: findings.inspect_rollout,
        kinds.VERTEX_LIST: findings.inspect_list,
    }
    return readers[kind](name)


def _fit(found: list[Finding], config: DictConfig) -> dict[str, Any] | None:
    """How the garments among the files sit on the body in the motion's first frame; None without garment or motion."""
    garments = [finding.file for finding in found if finding.kind.startswith("garment")]
    motions = [finding.file for finding in found if finding.kind == "motion"]
    bodies = [finding.file for finding in found if finding.kind in ("body model", "moving mesh")]
    if not garments or not (motions or bodies):
        return None
    body, motion = (bodies or [str(config.body)])[0], (motions or ["stand_sway"])[0]
    names = {"garments": garments, "body": body, "motion": motion}
    try:
        performed = load_motion(body, motion, MotionOptions(fps=float(config.fps), up=str(config.up), num_frames=2))
        scene = dress(read_outfit(garments, performed, triangulate=True), performed)
        skinned, start = fit_figures(scene, settled=False), fit_figures(scene)
    except (ValueError, OSError) as error:
        return {**names, "fits": False, "reason": " ".join(str(error).split())}
    height = float(
        performed.surface(0, performed.translation[0])[:, 1].max() - performed.surface(0, performed.translation[0])[:, 1].min()
    )
    fits = start.stretch_max <= _STRETCH_LIMIT and start.depth_max <= _DEPTH_LIMIT
    return {**names, "fits": fits, "body_height": height, "skinned": asdict(skinned), "start": asdict(start)}


def _as_dict(finding: Finding) -> dict[str, Any]:
    return {
        "file": finding.file,
        "kind": finding.kind,
        "facts": finding.facts,
        "problems": [{"problem": what, "fix": fix} for what, fix in finding.problems],
        "command": finding.command,
    }


def _text(found: list[Finding], fit: dict[str, Any] | None) -> str:
    lines = []
    for finding in found:
        lines.append(f"{finding.file}: {finding.kind}")
        lines += [f"  {name}: {_show(value)}" for name, value in finding.facts.items() if value not in (None, False)]
        lines += [f"  ! {what}; {fix}" for what, fix in finding.problems] or ["  nothing to repair"]
        if finding.command:
            lines.append(f"  repair: {finding.command}")
    return "\n".join([*lines, *(_fit_lines(fit) if fit else [])])


def _fit_lines(fit: dict[str, Any]) -> list[str]:
    head = f"{' + '.join(fit['garments'])} on {fit['body']} in the first frame of {fit['motion']}:"
    if "reason" in fit:
        return [head, f"  ! does not start: {fit['reason']}"]
    skinned, start = fit["skinned"], fit["start"]
    return [
        head,
        f"  body height {fit['body_height']:.2f} m, distance to the skin {1e3 * start['dist_median']:.0f} mm (median)",
        f"  skinned: {skinned['num_inside']} vertices inside to {1e3 * skinned['depth_max']:.1f} mm, "
        f"edges stretched by at most {100 * skinned['stretch_max']:.1f}%",
        f"  settled: {start['num_inside']} vertices inside to {1e3 * start['depth_max']:.1f} mm, "
        f"edges stretched by at most {100 * start['stretch_max']:.1f}%",
        "  they fit"
        if fit["fits"]
        else "  ! they do not fit: prepare the garment with the pose, scale and body it was made for",
    ]


def _show(value: Any) -> str:
    return ", ".join(_show(item) for item in value) or "none" if isinstance(value, (list, tuple)) else str(value)
