"""``hood sizes``: a size run, how a garment in several sizes sits on bodies of several shapes, as one sheet."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from omegaconf import DictConfig
from tqdm import tqdm

from hood.app.common import output_folder, prepare_folder, require_package
from hood.app.scene.garments import FITS
from hood.app.settings.compose import ConfigError, load_config, plain, require_choice, shown
from hood.app.settings.overrides import overrides
from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.setup import check_config, make_stepper, set_up, start_of
from hood.assets.files.atomic import write_atomically
from hood.media.film import Film
from hood.media.renderer.render import contact_sheet
from hood.media.video import save_png
from hood.rollouts.file.reader import RolloutData
from hood.rollouts.file.recorder import still_of
from hood.rollouts.frame import Ease, measure_ease
from hood.rollouts.loop import simulate
from hood.steppers.newton import Stepper

#: The sizes of a run that names none.
_USUAL = {"XS": 0.9, "S": 0.95, "M": 1.0, "L": 1.05, "XL": 1.1}
#: Pixels of one picture of the sheet.
_WIDTH, _HEIGHT = 300, 460
#: Keys that are those of ``hood rollout``.
_KEYS = ("garment", "fit", "sequence", "num_frames", "body", "material", "stepper", "checkpoint", "refine", "pins")


@dataclass(frozen=True)
class _Worn:
    """A size on a body at the last frame.

    Args:
        size: its name.
        shape: the body's shape coefficients.
        ease: how it sits.
        still: that frame alone, to be drawn.
    """

    size: str
    shape: tuple[float, ...]
    ease: Ease
    still: RolloutData


def run(arguments: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    config = load_config("sizes", arguments)
    require_choice(config, "fit", FITS)
    folder = output_folder(config)
    require_package("PIL", "Pillow", "pictures", "the sheet of hood sizes")
    asked = [_rollout_config(config, size, shape) for shape in _shapes(config) for size in _sizes(config).values()]
    for one in asked:
        check_config(one)
    if str(config.body) == "none":
        raise ConfigError("body=none: there is nobody who wears the garment; give a body")
    prepare_folder(folder)
    names = [(size, shape) for shape in _shapes(config) for size in _sizes(config)]
    stepper, _ = make_stepper(asked[0])
    runs = tqdm(zip(names, asked, strict=True), total=len(names), desc="sizes", disable=None)
    worn = [_wear(size, shape, one, stepper) for (size, shape), one in runs]
    print("\n".join(_table(worn)))
    record = [{"size": one.size, "shape": one.shape} | asdict(one.ease) | {"word": one.ease.word} for one in worn]
    write_atomically(folder / "sizes.json", json.dumps(record, indent=1).encode())
    save_png(folder / "sheet.png", _sheet(worn, len(_sizes(config))))
    print(f"\nwritten: {folder / 'sheet.png'}, {folder / 'sizes.json'}")
    return 0


def _sizes(config: DictConfig) -> dict[str, Any]:
    """What ``size`` of a rollout is to be, by the names of the sizes."""
    sizes = _USUAL if config.sizes is None else plain(config.sizes)
    if not isinstance(sizes, dict) or not sizes:
        raise ConfigError(f"sizes={shown(sizes)}: give names and factors, such as sizes={{S:0.95,M:1,L:1.05}}")
    for name, size in sizes.items():
        if isinstance(size, bool) or not isinstance(size, (int, float, list, dict)):
            raise ConfigError(
                f"sizes: {name} is {shown(size)}; give what size of hood rollout takes, such as sizes={{{name}:0.95}}"
            )
    return {str(name): size for name, size in sizes.items()}


def _shapes(config: DictConfig) -> list[tuple[float, ...]]:
    shapes = plain(config.shapes)
    if not isinstance(shapes, list) or not shapes or not all(isinstance(shape, list) for shape in shapes):
        raise ConfigError(
            f"shapes={shapes}: give lists of shape coefficients, such as shapes=[[],[2],[-2]]; [] is the mean body"
        )
    return [tuple(shape) for shape in shapes]


def _rollout_config(config: DictConfig, size: Any, shape: tuple[float, ...]) -> RolloutSettings:
    """The rollout of one size on one body: nothing is measured on the way."""
    keys = {key: config[key] for key in _KEYS} | {"size": size, "betas": list(shape)}
    keys |= {"metrics": "none", "guard": "off", "video": "none"}
    return RolloutSettings.from_words(overrides({key: plain(value) for key, value in keys.items()}))


def _wear(size: str, shape: tuple[float, ...], config: RolloutSettings, stepper: Stepper) -> _Worn:
    """The garment after the frames of its rollout."""
    ready = set_up(config, stepper, tell=lambda sentence: None)
    scene, count = ready.scene, min(int(config.num_frames), ready.scene.num_frames)
    frames = simulate(ready.stepper, scene, ready.potential, count, metrics="none", settle=start_of(ready.config)[0])
    (frame,) = deque(frames, maxlen=1)
    ease = measure_ease(scene, scene.cloth_at(frame.index), frame.state, frame.index)
    assert ease is not None  # there is a body
    still = RolloutData(
        frame.world_pos.numpy()[None],
        scene.garment.faces,
        scene.cloth.rest_pos.cpu().numpy(),
        frame.body_pos.numpy()[None],
        np.asarray(scene.motion.faces),
        np.zeros(1),
        {},
        {"garment": scene.garment.name},
        still=still_of(scene.garment, cloth=scene.cloth),
    )
    return _Worn(size, shape, ease, still)


def _table(worn: Sequence[_Worn]) -> list[str]:
    head = ("shape", "size", "sits", "skin mm, p5", "p50", "p95", "on skin", "stretched", "slid cm")
    rows: list[tuple[str, ...]] = [head]
    for one in worn:
        ease = one.ease
        gaps = [f"{1e3 * value:.0f}" for value in ease.gap]
        shares = (f"{100 * ease.on_skin:.0f}%", f"{100 * ease.stretch:.1f}%", f"{100 * ease.slid:.1f}")
        rows.append((_shown(one.shape), one.size, ease.word, *gaps, *shares))
    widths = [max(len(row[column]) for row in rows) + 2 for column in range(len(head))]
    return ["".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _shown(shape: tuple[float, ...]) -> str:
    return f"[{','.join(f'{value:g}' for value in shape)}]" if shape else "mean"


def _sheet(worn: Sequence[_Worn], columns: int) -> np.ndarray:
    """A row for each body, a column for each size; one scale of strain for all."""
    stills = [one.still for one in worn]
    pictures = []
    for place, one in enumerate(worn):
        others = stills[:place] + stills[place + 1 :]
        pictures.append(Film(one.still, _WIDTH, _HEIGHT, colour="strain", beside=others).frame(0))
    labels = [f"{one.size}, body {_shown(one.shape)}: {one.ease.word}" for one in worn]
    return contact_sheet(pictures, columns, labels)
