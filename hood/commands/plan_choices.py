"""What a rollout could be done with instead: coarser and finer meshes of its garment, and other time steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from omegaconf import DictConfig

from hood.assets.files.library import names
from hood.commands.cloth_contact import acts
from hood.commands.setup import make_scene
from hood.commands.steppers import option_of
from hood.config import plain, with_words
from hood.scene.held_layers import with_held_layers_apart
from hood.scene.scene import Scene

#: Frames a second below which a motion is not shown as one; beyond the other, steps are shorter than any motion needs.
_LEAST_FPS, _MOST_FPS = 24.0, 240.0
#: Kinds of choices.
MESH, TIME_STEP = "mesh", "time step"


@dataclass(frozen=True)
class Choice:
    """Another mesh or time step.

    Args:
        kind: :data:`MESH` or :data:`TIME_STEP`; of every kind at most one is taken.
        words: the settings.
        pace: its steps for one step of the full model.
        finer: it is finer than what was asked for: it is compared, never taken.
    """

    name: str
    kind: str
    purpose: str
    words: tuple[str, ...]
    pace: float = 1.0
    finer: bool = False


def choices_of(config: DictConfig) -> list[Choice]:
    """Of a settled config of ``hood rollout``; the coarsest mesh first, finer ones last."""
    return [*_meshes(config), *_time_steps(config)]


def choose_choices(config: DictConfig, asked: list[str]) -> list[Choice]:
    """Those of the names; where none is given all that are coarser, and the shorter time step."""
    there = choices_of(config)
    if asked:
        return [one for one in there if one.name in asked]
    return [one for one in there if not (one.finer and one.kind == MESH)]


def scene_of(config: DictConfig, words: Sequence[str]) -> Scene:
    """The scene of a settled config with the words of choices.

    Raises:
        ConfigError, ValueError, FileNotFoundError: as for a rollout.
    """
    other = with_words(config, words)
    scene = make_scene(other)
    return with_held_layers_apart(scene) if acts(other) else scene


def levels_of(garment: str) -> dict[str, int]:
    """Embedded meshes of the same garment with their thousands of vertices, coarse to fine: ``dress``, ``dress_4k``, …"""
    known, stem = names("garments"), garment.partition("_")[0]
    if garment not in known:
        return {}
    sizes = {name: int(name.rpartition("_")[2].rstrip("k")) for name in known if name.startswith(f"{stem}_")}
    return dict(sorted({stem: 1, **sizes}.items(), key=lambda pair: pair[1]))


def _meshes(config: DictConfig) -> list[Choice]:
    own = plain(config.garment)
    levels = levels_of(own) if isinstance(own, str) else {}
    if not levels or _by_vertices(config):
        return []
    found = []
    for name, size in levels.items():
        if name != own:
            finer = size > levels[own]
            purpose = "narrower folds" if finer else "fewer vertices, wider folds"
            found.append(Choice(f"mesh {name}", MESH, purpose, (f"garment={name}",), finer=finer))
    return found


def _by_vertices(config: DictConfig) -> bool:
    """Whether the config names vertices, which are those of one mesh: pins and parts by number or list."""
    pins = plain(config.pins)
    given = [*(pins if isinstance(pins, list) else [pins]), *(plain(config.fabrics) or {})]
    return any(isinstance(one, int) or str(one).endswith((".txt", ".json")) for one in given if one is not None)


def _time_steps(config: DictConfig) -> list[Choice]:
    """Twice and half as many steps; none for networks, which know the step of their training, and where frames are named."""
    if option_of(config).network or plain(config.events):
        return []
    fps, found = float(config.fps), []
    for pace, purpose in ((0.5, "fewer, longer steps"), (2.0, "shorter steps: motion is followed more closely")):
        if _LEAST_FPS <= pace * fps <= _MOST_FPS:
            frames = round((int(config.num_frames) - 1) * pace) + 1
            words = (f"fps={pace * fps:g}", f"num_frames={frames}")
            found.append(Choice(f"{pace * fps:g} fps", TIME_STEP, purpose, words, pace, finer=pace > 1.0))
    return found
