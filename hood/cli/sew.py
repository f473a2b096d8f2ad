"""``hood sew FILE`` or ``hood sew design:NAME``: a sewing pattern in; out the garment that it makes on a body, judged.

``hood sizes``: a size run, how a garment in several sizes sits on bodies of several shapes, as one sheet.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig
from scipy.spatial import cKDTree
from tqdm import tqdm

from hood.app.common import output_folder, prepare_folder, require_package, split_words
from hood.app.scene.fabrics import most_alike
from hood.app.scene.garments import FITS, shape_coefficients
from hood.app.scene.placing import AUTO, arm_angle
from hood.app.settings.compose import ConfigError, build, load_config, plain, require_choice, shown
from hood.app.settings.rollout_settings import RolloutSettings, overrides
from hood.app.setup import check_config, make_stepper, set_up, start_of
from hood.assets.body.body import Body
from hood.assets.body.load import load_body
from hood.assets.files.atomic import write_atomically
from hood.assets.files.library import unknown
from hood.assets.garment.binding import PosedBody, bind_posed
from hood.assets.garment.garment import Garment, save_garment
from hood.assets.material import Material, values_of
from hood.assets.pattern.designs import DESIGNS, draft
from hood.assets.pattern.making import ELASTIC, with_elastic
from hood.assets.pattern.measures import measure_body
from hood.assets.pattern.pattern import Pattern, read_pattern, write_pattern
from hood.assets.pattern.riding import riders_of
from hood.assets.pattern.sheet import PatternSheet, sheet_of
from hood.media.exports.sequences import write_obj
from hood.media.film import Film
from hood.media.renderer.render import contact_sheet
from hood.media.video import save_png
from hood.rollouts.file.reader import RolloutData
from hood.rollouts.file.recorder import still_of
from hood.rollouts.frame import Ease, measure_ease
from hood.rollouts.frames import ridden_faces, ridden_rest
from hood.rollouts.loop import simulate
from hood.rollouts.sewing import sew_pattern, sewn_open
from hood.rollouts.sewn import Sewn, strapless, waist_of
from hood.steppers.newton import Stepper

#: Exit code of a garment that is not sewn well.
UNSEWN = 3
_FINEST, _COARSEST = 0.004, 0.1
#: Folds this share of an edge apart have triangles of their own between them.
_RESOLVED = 0.8
#: Of ``waist``; what auto takes, at the waist and of a top without straps, how wide [m] its elastic is and how stiff in shear
#: [N/m]: 3 cm stretch by 10% under 1.5 N.
HELD, _DRAWN, _AT_CHEST, _WAISTBAND, _SHEAR = "held", 0.85, 0.95, 0.03, 169.0
#: How the word of an own design begins.
_DESIGN = "design:"
_WIDTH, _HEIGHT = 420, 560
#: Between panels in the picture [m], and pixels for its title.
_MARGIN, _TITLE = 0.02, 36


def run(arguments: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    words, config = split_words("sew", arguments)
    if len(words) != 1:
        given = f"{len(words)} files are given" if words else "no file is given"
        raise ConfigError(f"{given}: write one, hood sew specification.json output=shirt.npz, or hood sew design:tshirt")
    word, edge = words[0], _number(config, "edge", _FINEST, _COARSEST)
    gathers, angle = _number(config, "gathers", 1.0, 100.0), arm_angle(config.pose)
    if angle is None and str(config.pose) != AUTO:
        raise ConfigError(f"pose={shown(config.pose)}: give tpose, apose, degrees of the arms below the T-pose, or auto")
    material: Material = build(config.material)
    pattern, body, betas = _pattern(word, config, gathers)
    target = _target(config, pattern)
    picture, written, sheet = _picture(config, target), _specification(config), sheet_of(pattern, edge, word)
    sheet = _with_waist(sheet, _waist(config, sheet), material)
    prepare_folder(target.parent)
    if written is not None:
        prepare_folder(written.parent)
        write_pattern(written, pattern)
        print(f"written: {written}")
    posed, sewn = sew_pattern(pattern, sheet, body, betas, material, angle)
    sheet, sewn = sewn_open(sheet, sewn, posed, material)
    worn = _garment(pattern, sheet, sewn)
    print("\n".join([*_report(pattern, sheet, sewn), *near_folds(pattern, edge)]))
    if picture is not None:
        prepare_folder(picture.parent)
        save_png(picture, _sheet(worn, sheet, posed, most_alike(plain(config.material))))
        print(f"written: {picture}")
    faults = sewn.figures.faults
    if faults:
        unsewn = target.with_suffix(".unsewn.obj")
        write_obj(unsewn, worn)
        print(
            f"not sewn: {'; '.join(faults)}. How far it came is in {unsewn}; try another pose= or body=, or alter the pattern"
        )
        return UNSEWN
    save_garment(target, bind_posed(worn, posed))
    print(f"written: {target}")
    return 0


def _pattern(word: str, config: DictConfig, gathers: float) -> tuple[Pattern, Body, np.ndarray]:
    """The pattern of a file, or a design made to the measures of the body; that body, and its shape coefficients."""
    chosen, name = plain(config.design), word.removeprefix(_DESIGN)
    if chosen is not None and (name == word or not isinstance(chosen, dict)):
        example = "{length:0.3,ease:0.1}"
        raise ConfigError(f"design={shown(config.design)}: give options in braces, hood sew design:tshirt 'design={example}'")
    if name != word and name not in DESIGNS:
        raise ConfigError(unknown("design", name, DESIGNS))
    body, betas = load_body(str(config.body)), shape_coefficients(config.betas)
    if name == word:
        return read_pattern(Path(word).expanduser(), gathers), body, betas
    vertices, joints = body.shaped(betas)
    return draft(name, measure_body(vertices, body.faces, joints), chosen), body, betas


def _specification(config: DictConfig) -> Path | None:
    """Where the pattern itself is written; None: nowhere."""
    if config.pattern is None:
        return None
    path = Path(str(config.pattern)).expanduser()
    if path.suffix != ".json":
        raise ConfigError(f"pattern={path}: patterns are .json files")
    return path


def _number(config: DictConfig, key: str, low: float, high: float, other: str = "") -> float:
    value = config[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise ConfigError(f"{key}={shown(value)}: give a number from {low:g} to {high:g}{other}")
    return float(value)


def _waist(config: DictConfig, sheet: PatternSheet) -> float | None:
    """How many times as long as it is cut the elastic of a waist is at rest; None: it is held."""
    if str(config.waist) == AUTO:
        return _AT_CHEST if strapless(sheet) else _DRAWN
    if str(config.waist) == HELD:
        return None
    return _number(config, "waist", *ELASTIC, f", {AUTO} or {HELD}")


def _with_waist(sheet: PatternSheet, factor: float | None, material: Material) -> PatternSheet:
    """The pattern with elastic along its waist, where it has one and no elastic there."""
    rim = waist_of(sheet)
    if factor is None or not rim.any() or (rim & sheet.gathered).any():
        return sheet
    shear = float(np.mean(values_of(material.lame_mu)[0]) * np.mean(values_of(material.thickness)[0]))
    return with_elastic(sheet, rim, factor, _WAISTBAND, max(_SHEAR / shear, 1.0))


def _target(config: DictConfig, pattern: Pattern) -> Path:
    target = Path(f"{pattern.name or 'garment'}.npz" if config.output is None else str(config.output)).expanduser()
    if target.suffix != ".npz":
        raise ConfigError(f"output={target}: garments are .npz files")
    return target


def _picture(config: DictConfig, target: Path) -> Path | None:
    """Where the sheet goes; None for none."""
    word = str(config.sheet)
    if word == "none":
        return None
    picture = target.with_suffix(".png") if word == AUTO else Path(word).expanduser()
    if picture.suffix != ".png":
        raise ConfigError(f"sheet={word}: sheets are .png files; give one, auto or none")
    require_package("PIL", "Pillow", "pictures", "the sheet of hood sew (sheet=none draws none)")
    return picture


def _garment(pattern: Pattern, sheet: PatternSheet, sewn: Sewn) -> Garment:
    """The garment as it hangs; its lengths are those of the pattern."""
    return Garment(
        pattern.name,
        sewn.pos,
        sheet.faces,
        sewn.held,
        uv=sheet.uv,
        uv_faces=sheet.uv_faces,
        panels=dict(sheet.panels),
        flat=sheet.flat,
        stiffness=sheet.stiffness,
        fasteners=dict(sheet.rows) or None,
        riders=riders_of(pattern, sheet, sewn.pos),
        **vars(sheet.made),
    )


def _report(pattern: Pattern, sheet: PatternSheet, sewn: Sewn) -> list[str]:
    figures = sewn.figures
    lines = [
        f"{pattern.name}: {len(pattern.panels)} panels, {len(pattern.stitches)} stitches, {len(sheet.pos)} vertices, "
        f"{len(sheet.faces)} triangles",
        f"sewn in {sewn.steps} steps, {sewn.seconds:.0f} s: strain p99 {figures.strain_p99:.1%}; triangles through the "
        f"body {figures.body_crossings}, cloth {figures.self_crossings}; {figures.openings} openings",
    ]
    if sewn.held.any():
        lines.append(f"its waist is held, {int(sewn.held.sum())} vertices; pins=none of hood rollout lets it go")
    lines += [f"{name}: {len(pairs)} pairs; events of hood rollout open it" for name, pairs in sheet.rows.items()]
    if sheet.made.elastic is not None:
        count = int((sheet.made.elastic != 1.0).any(axis=1).sum())
        lines.append(f"elastic in {count} triangles; waist=held holds a waist instead")
    return lines


def near_folds(pattern: Pattern, edge: float) -> list[str]:
    """A line where folds of a panel are much nearer to each other than edges of the mesh are long [m]: pleats are strained."""
    middles = [[0.5 * (fold.start + fold.end) for fold in panel.folds] for panel in pattern.panels.values()]
    near = min((float(cKDTree(own).query(own, 2)[0][:, 1].min()) for own in middles if len(own) > 1), default=np.inf)
    if near > _RESOLVED * edge:
        return []
    finer = max(near, _FINEST)
    return [f"folds {1e3 * near:.0f} mm apart are strained by edges of {1e3 * edge:g} mm; edge={finer:.3f} resolves them"]


def _sheet(worn: Garment, sheet: PatternSheet, posed: PosedBody, fabric: str) -> np.ndarray:
    """The pattern, and the garment of a fabric from front, side and back: a picture (H, W, 3) uint8."""
    shown = ridden_rest(worn.rest_pos, worn)
    still = RolloutData(
        shown[None],
        ridden_faces(worn.faces, len(worn.rest_pos), worn.riders),
        shown,
        posed.surface[None],
        posed.faces,
        np.zeros(1),
        {},
        {"garment": worn.name, "fabric_names": fabric},
    )
    views = [Film(still, _WIDTH, _HEIGHT, azimuth_deg=azimuth).frame(0) for azimuth in (0.0, 90.0, 180.0)]
    return contact_sheet([_drawn(sheet), *views], 4, ["pattern", "front", "side", "back"])


def _drawn(sheet: PatternSheet) -> np.ndarray:
    """The panels side by side, in rows of about equal width, as a picture: their outlines and the mesh in them."""
    from PIL import Image, ImageDraw

    boxes = []
    for mask in _by_height(sheet):
        corners = sheet.uv[sheet.uv_faces[mask]]
        boxes.append((corners - corners.min(axis=(0, 1)), np.ptp(corners, axis=(0, 1)) + _MARGIN))
    wide = max(float(np.sqrt(sum(size.prod() for _, size in boxes) * _WIDTH / _HEIGHT)), *(float(size[0]) for _, size in boxes))
    placed, at, low, tall = [], 0.0, 0.0, 0.0
    for corners, size in boxes:
        if at and at + size[0] > 1.1 * wide:
            at, low, tall = 0.0, low + tall, 0.0
        placed.append(corners + [at, low])
        at, tall = at + float(size[0]), max(tall, float(size[1]))
    every = np.concatenate(placed)
    scale = 0.92 * min(_WIDTH / np.ptp(every[..., 0]), (_HEIGHT - _TITLE) / np.ptp(every[..., 1]))
    points = scale * (every - every.min(axis=(0, 1)))
    points[..., 1] = scale * np.ptp(every[..., 1]) - points[..., 1]
    points += [0.5 * (_WIDTH - points[..., 0].max()), _TITLE]
    image = Image.new("RGB", (_WIDTH, _HEIGHT), "white")
    pen = ImageDraw.Draw(image)
    for triangle in points.tolist():
        pen.polygon([tuple(corner) for corner in triangle], fill=(214, 226, 240), outline=(160, 182, 208))
    sides = np.sort(sheet.uv_faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, first, count = np.unique(sides, axis=0, return_index=True, return_counts=True)
    order = np.concatenate([np.flatnonzero(mask) for mask in _by_height(sheet)])
    row = np.empty(len(order), dtype=np.int64)
    row[order] = np.arange(len(order))
    for side in first[count == 1].tolist():
        face, corner = divmod(side, 3)
        ends = points[row[face], [corner, (corner + 1) % 3]]
        pen.line([tuple(end) for end in ends.tolist()], fill=(30, 60, 110), width=2)
    return np.asarray(image)


def _by_height(sheet: PatternSheet) -> list[np.ndarray]:
    """The panels, the tallest first."""
    return sorted(sheet.panels.values(), key=lambda mask: -float(np.ptp(sheet.uv[sheet.uv_faces[mask]][..., 1])))


#: The sizes of a run that names none.
_USUAL = {"XS": 0.9, "S": 0.95, "M": 1.0, "L": 1.05, "XL": 1.1}
#: Pixels of one picture of the sheet.
_SIZE_WIDTH, _SIZE_HEIGHT = 300, 460
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


def sizes(arguments: Sequence[str]) -> int:
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
    save_png(folder / "sheet.png", _sheet_of_sizes(worn, len(_sizes(config))))
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


def _sheet_of_sizes(worn: Sequence[_Worn], columns: int) -> np.ndarray:
    """A row for each body, a column for each size; one scale of strain for all."""
    stills = [one.still for one in worn]
    pictures = []
    for place, one in enumerate(worn):
        others = stills[:place] + stills[place + 1 :]
        pictures.append(Film(one.still, _SIZE_WIDTH, _SIZE_HEIGHT, colour="strain", beside=others).frame(0))
    labels = [f"{one.size}, body {_shown(one.shape)}: {one.ease.word}" for one in worn]
    return contact_sheet(pictures, columns, labels)
