"""Reading the garments that a command is given: one or several, repaired or not, with their pins.

``size=``, ``fit=`` and how the garment sits, ``pins=`` and what they follow: keys of a rollout, and what its summary says.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from hood.app.scene.garment_files import read_garment
from hood.app.settings.compose import ConfigError, brief, plain, require_choice, shown
from hood.app.settings.rollout_settings import Settings, fixed_shapes
from hood.assets.body.load import load_body
from hood.assets.fitting.alterations import OPENING, SHORT, join_short_edges, part_open_seams, turn_flat_faces
from hood.assets.fitting.placement import require_metres, used
from hood.assets.fitting.suspicions import Suspicion, suspect_kind, suspect_seams
from hood.assets.garment.garment import Garment
from hood.assets.garment.outfit import join_garments
from hood.assets.garment.parts import elasticated, tailored
from hood.assets.garment.pins import Pins, pin_groups, pin_mask
from hood.assets.garment.record import Wanted
from hood.mesh.editing.repair import FLAT
from hood.rollouts.file.reader import RolloutData
from hood.rollouts.frame import Ease
from hood.scene.body_motion.motion import BodyMotion, Motion
from hood.scene.following import held_by, stiffness_of
from hood.scene.scene import Scene
from hood.scene.sizing import Sizes, sizes_of


def names_of(given: Any, key: str = "garment") -> list[str]:
    """Names in a config value that is one name or a list of them.

    Raises:
        ConfigError: neither, or an empty list.
    """
    value = plain(given)
    names = value if isinstance(value, list) else [value]
    if not names or not all(isinstance(name, (str, int, float)) and not isinstance(name, bool) for name in names):
        raise ConfigError(f"{key}={brief(value)}: give a name, a file, or several, {key}=[shirt.obj,trousers]")
    return [str(name) for name in names]


def names_of_own(given: Garment | Sequence[Garment | str] | None) -> list[str]:
    """Names of what stands for ``garment`` of a config; none where nothing does, or one garment alone."""
    return [] if given is None or isinstance(given, Garment) else [getattr(one, "name", str(one)) for one in given]


def read_outfit(
    given: Any, motion: Motion, triangulate: bool = False, pins: Any = None, wanted: Wanted | None = None
) -> Garment:
    """The garment or garments named by a config value, as one garment that can follow ``motion``.

    Args:
        given: a name, a file, a garment that is read already, or a list of these.
        triangulate: split polygons of mesh files instead of refusing them.
        pins: what is held instead of the files' own pins, see :func:`hood.assets.garment.pins.pin_mask`; None: the files' own.
        wanted: what is asked of files that are not one sheet of cloth; None: what is usual.

    Raises:
        ValueError: a garment that cannot be read, is not in metres or does not fit, or pins it does not have.
    """
    if isinstance(given, Garment):
        garments = [given]
    else:
        beside, wanted = _measured_against(motion), wanted or Wanted()
        own = isinstance(given, Sequence) and any(isinstance(one, Garment) for one in given)
        garments = [
            one if isinstance(one, Garment) else read_garment(str(one), wanted, beside, triangulate)
            for one in (given if own else names_of(given))
        ]
    for garment in garments:
        if not garment.bound:
            heed(garment.name, suspect_seams(garment.rest_pos, garment.faces))
    garments = [as_simulated(garment) for garment in garments]
    pins = plain(pins)
    if pins is not None:  # what is held differs in how it follows the body
        garments = [replace(garment, pinned=np.zeros_like(garment.pinned)) for garment in garments]
    if motion.num_vertices:
        surface = motion.surface(0, motion.translation[0]).cpu().numpy()
        for garment in garments:
            if not garment.bound:
                require_metres(used(garment.rest_pos, garment.faces), surface, garment.name)
                heed(garment.name, suspect_kind(garment.rest_pos, garment.faces, surface))
    outfit = join_garments([motion.dressed(garment) for garment in garments])
    if pins is None:
        return outfit
    body = motion.body if isinstance(motion, BodyMotion) else None
    return replace(outfit, pinned=pin_mask(checked_pins(pins), outfit, body))


def _measured_against(motion: Motion) -> np.ndarray:
    """(W, 3) m: the body that says how large a garment may be; the default one where there is none."""
    if motion.num_vertices:
        return motion.surface(0, motion.translation[0]).double().cpu().numpy()
    return load_body("default").v_template


def as_simulated(garment: Garment) -> Garment:
    """The garment without what no step can resolve: short edges, flat faces, open seams that lie on each other. Vertices keep
    their numbers. Warnings say what was done; of seams of garments that are not bound :func:`suspect_seams` does."""
    joined, near = join_short_edges(garment)
    turned, flat = turn_flat_faces(joined)
    parted, doubled = part_open_seams(turned)
    for count, what in (
        (
            near,
            f"vertices lie within {SHORT:g} of an edge's length of a neighbour; faces take the neighbour, and those vertices "
            "are left out of the simulation",
        ),
        (flat, f"faces are lower than {FLAT:g} of their length; they are divided anew with their neighbours"),
        (
            doubled if garment.bound else 0,
            f"vertices lie on others along open seams, which hold nothing together; they are drawn back by "
            f"{1e3 * OPENING:g} mm, hood prepare garment=… sews them",
        ),
    ):
        if count:
            warnings.warn(f"garment {garment.name!r}: {count} {what}", stacklevel=2)
    return parted


def layer_order(given: Any, names: Sequence[str]) -> tuple[int, ...] | None:
    """Garments from the body outwards, by their places among ``names`` (of files the stem is enough); None for ``auto``.

    Raises:
        ConfigError: ``given`` is not ``auto``, nor all of the names in some order.
    """
    if plain(given) == "auto":
        return None
    wanted, left, order = names_of(given, "layers"), list(enumerate(names)), []
    for name in wanted:
        place = next((item for item in left if name in (item[1], Path(item[1]).stem)), None)
        if place is None:
            break
        left.remove(place)
        order.append(place[0])
    if left or len(order) != len(wanted):
        raise ConfigError(
            f"layers={','.join(wanted)}: give all garments from the body outwards, layers=[{','.join(names)}] or another order"
        )
    return tuple(order)


def heed(name: str, suspicions: Sequence[Suspicion]) -> None:
    """Warn about what the garment ``name`` seems to be.

    Raises:
        ValueError: a grave suspicion.
    """
    for suspicion in suspicions:
        if suspicion.grave:
            raise ValueError(f"garment {name!r} {suspicion.sentence}")
        warnings.warn(f"garment {name!r} {suspicion.sentence}", stacklevel=2)


def checked_pins(pins: Any) -> Pins:
    """A config value for pins: a word, a number, a table, or a list of them.

    Raises:
        ConfigError: something else.
    """
    one: list[Any] = pins if isinstance(pins, list) else [pins]
    if all(isinstance(pin, (str, int, dict)) and not isinstance(pin, bool) for pin in one):
        return one
    raise ConfigError(
        f"pins={brief(pins)}: give vertex numbers, regions or lists, such as pins=[waistband,12,13] or pins=held.txt"
    )


def shape_coefficients(given: Any, key: str = "betas") -> np.ndarray:
    """Ten shape coefficients from a config value of at most ten finite numbers; ``key`` is where it stands.

    Raises:
        ConfigError: something else.
    """
    values = plain(given)
    numbers = isinstance(values, list) and all(isinstance(b, (int, float)) and np.isfinite(b) for b in values)
    if not numbers or len(values) > 10:
        raise ConfigError(f"{key}={brief(values)}: give at most 10 finite shape coefficients, e.g. [1.5,0,-1]")
    return np.array([*values, *[0.0] * (10 - len(values))], dtype=np.float64)


#: Seconds in which a garment grows or shrinks.
_GROWING = 2.0
#: Whether the pattern follows the body's shape, or is that of the mean body for everybody.
FITS = ("betas", "none")


def checked_sizes(config: Settings) -> Sizes:
    """The sizes that the config asks for.

    Raises:
        ConfigError: they are none, or they change in steps of fixed shapes.
    """
    (end, seconds), parts = _end_of(config), checked_parts(config)
    require_choice(config, "fit", FITS)
    if parts and end is not None:
        raise ConfigError(f"size_end={end}: parts of a garment keep their size; give size as one factor or three")
    size, factors = 1.0 if parts else plain(config.size), tuple(factor for own in parts.values() for factor in own.values())
    for key, value in (("size", size), ("size_end", size if end is None else end)):
        try:
            sizes = replace(sizes_of(value), parts=factors)
        except (ValueError, TypeError) as error:
            raise ConfigError(f"{key}={shown(config[key])}: {error}") from error
    sizes = replace(sizes_of(size, end, seconds), parts=factors)
    if sizes.changing and fixed_shapes(config):
        raise ConfigError(
            f"size_end={end}: step={config.step} has fixed shapes, which a garment that grows has not; use step=plain"
        )
    return replace(sizes, to_measure=str(config.fit) == "betas")


def _end_of(config: Settings) -> tuple[Any, float]:
    """What ``size_end`` says: the last size, None where it stays, and the seconds until then."""
    value = plain(config.size_end)
    if not isinstance(value, dict):
        return value, _GROWING
    seconds = value.get("seconds", _GROWING)
    if not {"size"} <= value.keys() <= {"size", "seconds"} or value["size"] is None:
        raise ConfigError(
            f"size_end={shown(value)}: give a size, or a size and seconds, such as size_end={{size:1.1,seconds:3}}"
        )
    if isinstance(seconds, bool) or not isinstance(seconds, (int, float)) or not seconds > 0:
        raise ConfigError(f"size_end: seconds is {shown(seconds)}; give seconds above 0, such as {{size:1.1,seconds:3}}")
    return value["size"], float(seconds)


def checked_parts(config: Settings) -> dict[str, dict[str, float]]:
    """What ``size`` says of parts, where it is a table of them: each with ``factor``, ``elastic`` or both; else empty.

    Raises:
        ConfigError: a factor that is no number.
    """
    value = plain(config.size)
    if not isinstance(value, dict):
        return {}
    if not value:
        raise ConfigError("size={}: names no part; give parts and factors, such as size={sleeves:1.2}, or one factor")
    parts = {str(part): own if isinstance(own, dict) else {"factor": own} for part, own in value.items()}
    for part, own in parts.items():
        if not own or not own.keys() <= {"factor", "elastic"}:
            raise ConfigError(
                f"size: {part} is {shown(value[part])}; give factor, elastic or both, {{{part}:{{elastic:0.85}}}}"
            )
        for key, factor in own.items():
            if isinstance(factor, bool) or not isinstance(factor, (int, float)):
                where = f"{part} is {factor!r}" if value[part] is factor else f"{key} of {part} is {factor!r}"
                raise ConfigError(f"size: {where}; give a factor of the part, such as size={{{part}:1.1}}")
    return {part: {key: float(factor) for key, factor in own.items()} for part, own in parts.items()}


def cut_to_size(config: Settings, garment: Garment, motion: Motion) -> Garment:
    """``garment`` with its parts cut, and drawn together, as the config asks for, if it does.

    Raises:
        ValueError: it names a part that the garment does not have.
    """
    parts, body = checked_parts(config), motion.body if isinstance(motion, BodyMotion) else None
    for key, change in (("factor", tailored), ("elastic", elasticated)):
        factors = {part: own[key] for part, own in parts.items() if key in own}
        garment = change(garment, factors, body) if factors else garment
    return garment


def summarise_ease(first: Ease | None, last: Ease | None) -> dict[str, Any]:
    """What ``summary.json`` says of how the garment sat in frame 0 and in the last one; nothing where it was not measured."""
    if first is None or last is None:
        return {}
    return {"ease": {name: asdict(ease) | {"word": ease.word} for name, ease in (("first", first), ("last", last))}}


def describe_ease(summary: Mapping[str, Any]) -> list[str]:
    """A line on it; none where the summary does not say."""
    found = summary.get("ease")
    if not found:
        return []
    words = []
    for name, when in (("first", "frame 0"), ("last", "the last frame")):
        ease = found[name]
        low, middle, high = (1e3 * value for value in ease["gap"])
        skin = f"skin {low:.0f}, {middle:.0f}, {high:.0f} mm away at p5, p50, p95; on the skin {100 * ease['on_skin']:.0f}%"
        skin = skin if low == low else "no skin within 10 cm"
        stretched = f"stretched by {100 * ease['stretch']:.1f}% there; upper rim {100 * ease['slid']:.0f} cm down"
        words.append(f"{when}: {ease['word']} ({skin}, {stretched})")
    return ["size, " + "; ".join(words)]


def with_pins(scene: Scene, config: Settings) -> Scene:
    """The scene whose pins follow what the config says, some of them by springs; the same where it says nothing of that.

    Raises:
        ValueError: there is no body to follow, no such part of it, or none near.
    """
    pins = plain(config.pins)
    if pins is None:
        return scene
    body = scene.motion.body if isinstance(scene.motion, BodyMotion) else None
    return replace(scene, held=held_by(pin_groups(pins, scene.garment, body), scene.motion, scene.garment))


def summarise_pins(scene: Scene, data: RolloutData) -> dict[str, Any]:
    """Of every group of pins that follow something or are springs: how many vertices, how many of them by springs of which
    constants, what they follow, and how far [m] they were from there at most. Nothing of other scenes."""
    if scene.held is None:
        return {}
    rows = []
    for group in scene.held.groups:
        soft = stiffness_of(group.weights[~group.exact])
        rows.append(
            {
                "vertices": len(group.vertices),
                "soft": len(soft),
                "stiffness_N_per_m": [float(soft.min()), float(soft.max())] if len(soft) else None,
                "follows": group.whom,
                "off_max_m": _farthest(scene, data, group.vertices[group.exact]),
                "off_soft_max_m": _farthest(scene, data, group.vertices[~group.exact]),
            }
        )
    return {"pins": rows}


def _farthest(scene: Scene, data: RolloutData, vertices: np.ndarray) -> float | None:
    """How far [m] vertices (P,) were from where pins hold them in a frame, at most; None of none, or where some are let go."""
    if not len(vertices) or scene.holding is not None:
        return None
    worst, motion = 0.0, scene.motion
    for frame, pos in enumerate(data.step_pos(vertices)):
        origin = motion.translation[frame]
        there = scene.skinned(frame, origin).cpu().double().numpy()[vertices] + origin
        worst = max(worst, float(np.linalg.norm(pos - there, axis=1).max()))
    return worst


def describe_pins(summary: Mapping[str, Any]) -> list[str]:
    """A line on every group of pins."""
    lines = []
    for row in summary.get("pins", []):
        exact, soft = row["vertices"] - row["soft"], row["soft"]
        low, high = row["stiffness_N_per_m"] or (0.0, 0.0)
        springs = f"by springs of {low:.3g}{'' if low == high else f' to {high:.3g}'} N/m"
        said = [f"{exact} vertices are held" + _off_by(row["off_max_m"])] if exact else []
        said += [f"{soft} {springs}" + _off_by(row["off_soft_max_m"])] if soft else []
        lines.append(f"pins: {', '.join(said) or 'none'}; they follow {row['follows']}")
    return lines


def _off_by(metres: float | None) -> str:
    return "" if metres is None else f", at most {1e3 * metres:.2f} mm off"
