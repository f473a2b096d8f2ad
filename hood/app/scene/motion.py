"""Reading the body and motion that a command is given."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from typing import TYPE_CHECKING, Any

import torch

from hood.app.notices import say
from hood.app.settings.compose import ConfigError, brief, plain, require_choice, shown
from hood.app.settings.rollout_settings import Settings, objects
from hood.assets.body.body import Body
from hood.assets.files.library import names
from hood.assets.garment.garment import Garment
from hood.assets.motion.animated_mesh import BodyMesh, body_kind
from hood.assets.motion.load import HANDS
from hood.assets.motion.sequence import PoseSequence
from hood.assets.motion.skeleton import TRANSLATION_UNITS
from hood.scene.body_motion.load import NO_MOTION, MotionOptions, load_motion
from hood.scene.body_motion.motion import Motion

if TYPE_CHECKING:
    from hood.assets.material import Material


@dataclass(frozen=True)
class Own:
    """Objects that stand for what a config names; None: what it names.

    Args:
        garment: one, or a list of objects and names.
    """

    garment: Garment | Sequence[Garment | str] | None = None
    material: Material | None = None
    body: Body | BodyMesh | None = None
    sequence: PoseSequence | None = None


#: A config that names everything.
NAMED = Own()


#: Values of the keys that take numbers.
_SUCH_AS = {"fps": 30, "file_fps": 120}
#: From which the body moves into the motion: arms out, or lowered by 45 degrees.
_POSES = ("t", "a")
#: Keys of one word and their words; a null is the file's own.
_WORDS = {
    "hands": HANDS,
    "gender": ("neutral", "male", "female"),
}


def check_motion_options(config: Settings) -> None:
    """Raise ConfigError where a key that says how a motion is performed has a value that none can have, used or not."""
    for key, known in _WORDS.items():
        if config[key] is not None:
            require_choice(config, key, known)
    _blend(config)
    _unit(config)
    rate = _optional(config, "file_fps")
    if rate is not None and not rate > 0:
        raise ConfigError(f"file_fps={shown(config.file_fps)}: give a number above 0, such as file_fps={_SUCH_AS['file_fps']}")
    check_rate(config)


def check_rate(config: Settings, key: str = "fps") -> None:
    """Raise ConfigError unless a key is a frame rate at which steps can be taken."""
    value: Any = reduce(getitem, key.split("."), config)
    if not 1.0 <= float(value) <= 1000.0:
        raise ConfigError(f"{key}={value}: give the simulation's frames per second, 1 to 1000")


def make_motion(config: Settings, dtype: torch.dtype = torch.float32, own: Own = NAMED) -> Motion:
    """What moves in the scene, in ``dtype`` on the config's device.

    A body that performs no motion but its own does so beside an embedded motion, the default, and says that; a file was
    meant.

    Raises:
        FileNotFoundError, ValueError: from :func:`hood.scene.body_motion.load.load_motion`.
        ConfigError: a value of the wrong kind, or a motion file that the body cannot perform; names the key.
    """
    kind = "model" if own.body is not None else body_kind(str(config.body))
    if kind != "model" and own.sequence is not None:
        raise ConfigError(f"sequence: body={config.body} has its own motion, or none; leave sequence out")
    if kind != "model" and str(config.sequence) != NO_MOTION:
        has = "performs its own motion" if kind == "mesh" else "does not move"
        if str(config.sequence) not in names("motions"):
            raise ConfigError(
                f"sequence={config.sequence}: body={config.body} {has}; leave sequence out, or give a body of the SMPL family"
            )
        say(f"body={config.body} {has}: sequence={config.sequence} is not used", error=True)
    return perform(config, own, motion_options(config), dtype, str(config.device))


def perform(config: Settings, own: Own, options: MotionOptions, dtype: torch.dtype, device: torch.device | str) -> Motion:
    """The body and the motion that the config names, or that are given, with these options."""
    body = str(config.body) if own.body is None else own.body
    sequence = str(config.sequence) if own.sequence is None else own.sequence
    return load_motion(body, sequence, options, dtype, device)


def motion_options(config: Settings) -> MotionOptions:
    """The keys of a config that say how a motion is performed.

    Raises:
        ConfigError: a value of the wrong kind; names the key.
    """
    return MotionOptions(
        fps=_number(config, "fps"),
        up=str(config.up),
        start=config.start,
        stop=config.stop,
        loop=int(config.loop),
        file_fps=_optional(config, "file_fps"),
        num_frames=int(config.num_frames),
        betas=_betas(plain(config.betas)),
        gender=None if config.gender is None else str(config.gender),
        blend_in=_blend(config)[0],
        blend_from=_blend(config)[1],
        hands=str(config.hands),
        person=None if config.person is None else str(config.person),
        trans_unit=_unit(config)[0],
        scale=_unit(config)[1],
        animation=config.animation,
        parts=[str(name) for name in objects(config).body],
    )


def is_blended(config: Settings) -> bool:
    """Whether the body moves into the motion from a standing pose."""
    return _blend(config)[0] != 0


def _blend(config: Settings) -> tuple[float, str]:
    """What ``blend_in`` says: seconds, and the pose in which they begin."""
    value = plain(config.blend_in)
    seconds, pose = value if isinstance(value, list) and len(value) == 2 else (value, _POSES[0])
    if isinstance(seconds, bool) or not isinstance(seconds, (int, float)) or pose not in _POSES:
        poses = " or ".join(_POSES)
        raise ConfigError(f"blend_in={shown(value)}: give seconds, blend_in=1, or seconds and a pose, {poses}, blend_in=[1,a]")
    return float(seconds), str(pose)


def _unit(config: Settings) -> tuple[str, float | None]:
    """What ``unit`` says: the name of the unit, "auto" where it says nothing, and its metres."""
    value = config.unit
    if value is None:
        return "auto", None
    if value in TRANSLATION_UNITS:
        return str(value), TRANSLATION_UNITS[value]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < math.inf:
        names = ", ".join(TRANSLATION_UNITS)
        raise ConfigError(f"unit={brief(value)}: give {names}, or metres per unit of the file, above 0, such as unit=0.01")
    return next((name for name, metres in TRANSLATION_UNITS.items() if metres == value), f"{value:g}"), float(value)


def _number(config: Settings, key: str) -> float:
    try:
        return float(config[key])
    except (TypeError, ValueError):
        raise ConfigError(f"{key}={shown(config[key])}: give a number, such as {key}={_SUCH_AS[key]}") from None


def _optional(config: Settings, key: str) -> float | None:
    return None if config[key] is None else _number(config, key)


def _betas(given: Any) -> Any:
    if given is None:
        return None
    # bool is an int, and no coefficient.
    if not isinstance(given, list) or not all(isinstance(b, (int, float)) and not isinstance(b, bool) for b in given):
        raise ConfigError(f"betas={brief(given)}: give at most 10 finite shape coefficients, e.g. betas=[1.5,0,-1]")
    return given
