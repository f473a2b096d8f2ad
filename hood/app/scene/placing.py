"""Where a garment belongs: one search for ``hood prepare``, which puts it there, and ``hood inspect``, which names the keys."""

from __future__ import annotations

from typing import Any

import numpy as np

from hood.app.settings.compose import ConfigError, plain, require_choice
from hood.app.settings.rollout_settings import Settings
from hood.assets.body.body import Body
from hood.assets.fitting.fit_search import CLOSE, AskedFit, FoundFit, Resized, Wearer, find_placement
from hood.assets.fitting.placement import UPWARD, Placement, find_scale, possible, size_ratio, used
from hood.assets.garment.binding import PosedBody, posed_body
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence_edit import A_POSE_ANGLE, arms_down
from hood.scene.body_motion.mesh_motion import MeshMotion, wearable

AUTO = "auto"
#: Meshes larger than this [m] are rooms and vehicles: places on them are not searched for.
_LARGEST_BODY = 4.0
_TURNS = (0, 90, 180, 270)
_ANGLES = {"tpose": 0.0, "apose": A_POSE_ANGLE}


def asked_keys(config: Settings) -> AskedFit:
    """What ``scale``, ``up``, ``turn`` and ``offset`` of a config fix.

    Raises:
        ConfigError: a value of the wrong kind; names the key.
    """
    require_choice(config, "up", (AUTO, *UPWARD))
    given = {key: plain(config[key]) for key in ("scale", "up", "turn", "offset")}
    if given["turn"] != AUTO and given["turn"] not in _TURNS:
        raise ConfigError(
            f"turn={given['turn']}: give auto or one of {', '.join(map(str, _TURNS))}, degrees about the vertical"
        )
    return AskedFit(
        scale=None if given["scale"] == AUTO else _scale(given["scale"]),
        up=None if given["up"] == AUTO else given["up"],
        turn=None if given["turn"] == AUTO else float(given["turn"]),
        offset=None if given["offset"] == AUTO else _offset(given["offset"]),
    )


def arm_angle(pose: Any) -> float | None:
    """The angle [degrees] that a value of ``pose`` names: ``tpose``, ``apose`` or a number; None: auto, a motion or a file.

    Raises:
        ConfigError: more than the arms can be lowered.
    """
    word = str(pose)
    try:
        angle = _ANGLES[word] if word in _ANGLES else float(word)
    except ValueError:
        return None
    if not 0 <= angle <= 90:
        raise ConfigError(f"pose={word}: give 0 to 90, degrees of the arms below those of the T-pose")
    return angle


def find_place(garment: Garment, body: Body, betas: np.ndarray, asked: AskedFit, posed: PosedBody | None) -> FoundFit:
    """The placement of an unbound garment on ``body`` of shape ``betas``, in a pose between T and arms hanging or in ``posed``.

    Nothing is searched where everything is asked for.
    """
    given = (asked.scale, asked.up, asked.turn, asked.offset)
    if posed is not None and all(value is not None for value in given):
        return FoundFit(_as_asked(asked), 0.0, 1.0)
    if posed is not None:
        wearer = _statue(posed.surface, body.faces)
    else:
        wearer = Wearer(lambda angle: posed_body(body, arms_down(angle), 0, betas).surface, body.faces)
    return find_placement(garment.rest_pos, garment.faces, wearer, asked)


def find_place_on_mesh(garment: Garment, motion: MeshMotion, asked: AskedFit) -> FoundFit | None:
    """The placement of an unbound garment on a mesh as it stands in its first frame, or in its rest pose where that is closer.

    None where nothing is searched and the garment stays where it is: a sheet has no place on a body, and a mesh larger than
    a person is none.
    """
    surfaces = [motion.points(0)] + ([] if motion.sequence.rest is None else [motion.sequence.rest])
    if garment.bound or not wearable(garment) or float(np.ptp(surfaces[0], axis=0).max()) > _LARGEST_BODY:
        return None
    best: FoundFit | None = None
    for surface in surfaces:
        found = find_placement(garment.worn_pos, garment.faces, _statue(surface, motion.faces), asked)
        best = found if best is None or _rank(found) < _rank(best) else best
    return best


def _rank(found: FoundFit) -> tuple[bool, bool, float]:
    """What lies around one surface where it is stays there, unless it fits another closely."""
    return found.refusal is not None, not found.worn and found.misfit > CLOSE, found.misfit


def _statue(surface: np.ndarray, faces: np.ndarray) -> Wearer:
    """A body in one pose."""
    return Wearer(lambda angle: surface, faces, angles=(0.0,))


def explain_size(resized: Resized) -> tuple[str, str]:
    """What is said of a garment that another size explains clearly better, and what to do, in words that follow "it"."""
    cut = "tight" if resized.factor > 1 else "loose"
    return (
        f"lies around the body more closely at {resized.factor:.3g} times its size (misfit less by {resized.gain:.2f})",
        f"{resized.placement.keys()[0]} resizes it, rest lengths too; leave scale out if its cut is meant to be so {cut}",
    )


def unit_alone(garment: Garment, body: Body, betas: np.ndarray) -> str | None:
    """The key of an unbound garment that is worn where it lies once its unit is known; None: it is not, or is in metres."""
    units = possible(used(garment.rest_pos, garment.faces), body.shaped(betas)[0])
    if len(units) != 1 or units[0] == 1.0:
        return None
    found = find_place(garment, body, betas, AskedFit(scale=units[0]), None)
    place = found.placement
    stays = place.up == "y" and place.turn == 0 and not place.offset.any()
    return place.keys()[0] if stays and found.refusal is None and found.resized is None else None


def explain_unplaced(unit: str | None) -> str:
    """What to do with a garment that no place is sure for; ``unit`` is that of :func:`unit_alone`."""
    enough = "" if unit is None else f"if it was made around this body, {unit} is enough; else "
    return f"{enough}give the body that it was made for (body=…, betas=…), or scale, up, turn, offset and pose"


def keep_place(garment: Garment, surface: np.ndarray, asked: AskedFit) -> Placement:
    """The placement of a bound garment: it stays where its binding has it, but for what is asked and its unit.

    Raises:
        ValueError: its size fits no unit.
    """
    pos = used(garment.rest_pos, garment.faces)
    scale = find_scale(pos, surface) if asked.scale is None else asked.scale
    if scale is None:
        ratio = size_ratio(pos, surface)
        raise ValueError(
            f"{garment.name}: {ratio:.3g} times the body's height fits no unit; give scale=FACTOR, metres per unit"
        )
    return _as_asked(AskedFit(scale, asked.up, asked.turn, asked.offset))


def _as_asked(asked: AskedFit) -> Placement:
    offset = np.zeros(3) if asked.offset is None else asked.offset
    return Placement(asked.scale or 1.0, asked.up or "y", asked.turn or 0.0, offset)


def _scale(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not (np.isfinite(value) and value > 0):
        raise ConfigError(f"scale={value}: give metres per unit of the file, such as 0.01 for centimetres, or auto")
    return float(value)


def _offset(value: Any) -> np.ndarray:
    numbers = isinstance(value, list) and all(isinstance(x, (int, float)) and np.isfinite(x) for x in value)
    if not numbers or len(value) != 3:
        raise ConfigError(f"offset={value}: give metres along x, y and z, offset=[0,1.2,0], or auto")
    return np.array(value, dtype=np.float64)
