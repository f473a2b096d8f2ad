"""``hood export rollout.h5 format=usd``: a rollout as files that other programs open.

``texture=``: images on the garments of rollouts.

Files of the rollout that was in a folder before: without them, what lies there is of one rollout.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from omegaconf import DictConfig

from hood.app.batch.batch import STATE
from hood.app.common import frame_count, split_words
from hood.app.settings.compose import ConfigError, plain, require_choice, shown
from hood.app.settings.rollout_settings import Settings
from hood.assets.files.atomic import write_atomically
from hood.assets.files.library import unknown
from hood.assets.formats.raw_mesh import Texture, read_texture
from hood.assets.formats.usd import NO_USD, has_usd
from hood.assets.garment.garment import Garment
from hood.media.exports.scene_files import gltf_bytes, image_name, write_usd
from hood.media.exports.sequences import (
    PARTS,
    Clip,
    PointCacheFiles,
    clip_of,
    write_mdd,
    write_obj_sequence,
    write_ply_sequence,
    write_point_cache,
)
from hood.media.pieces import GarmentPiece, layer_distances, pieces_by, pieces_of, plain_name
from hood.rollouts.file.compact import STORES
from hood.rollouts.file.reader import RolloutData, read_rollout
from hood.rollouts.file.recorder import still_of

_SUFFIXES = {"usd": (".usd", ".usdc", ".usda"), "glb": (".glb",)}
_FOLDERS: dict[str, Callable[[Path, Clip], None]] = {
    "pc2": write_point_cache,
    "mdd": write_mdd,
    "obj": write_obj_sequence,
    "ply": write_ply_sequence,
}
FORMATS = ("usd", "glb", *_FOLDERS)
#: Cloth is no thicker [m].
_THICKEST = 0.02
#: Those that hold images.
_TEXTURED = ("usd", "glb", "pc2", "mdd", "obj")


def export(arguments: Sequence[str]) -> tuple[Path, list[str]]:
    """Write what the command's words ask for: the file or folder, and what there is to say of it."""
    files, config = split_words("export", arguments)
    if len(files) != 1:
        raise ConfigError(f"number of rollouts given: {len(files)}; give one, hood export rollout.h5")
    source = Path(files[0]).expanduser()
    source = source / "rollout.h5" if source.is_dir() else source
    form, wanted = _checked(config)
    textures = read_textures(config)
    _check_textured(textures, [form], "format", f"format={form}")
    for key, asked in (("texture", bool(textures)), ("thickness", wanted.thickness != 0)):
        if asked and "cloth" not in wanted.parts:
            left_out = f"parts={wanted.parts} leaves the garments out"
            raise ConfigError(f"{key}: {left_out}; leave {key}= out, or take parts=[cloth,body]")
    target = _target(config, source, form)
    data = read_checked(source, "fabric")
    said = [_export(source, data, target, form, textures, wanted)]
    if not bool(data.attributes.get("complete", True)):
        there = f"{len(data.time)} of {data.attributes.get('num_planned', '?')} frames are there"
        said.append(f"the rollout is not finished: {there}")
    return target, said


def check_outputs(config: Settings) -> None:
    """Refuse formats of ``hood rollout formats=[…]`` that cannot be written, and images that nothing would show, before the
    first frame.

    Raises:
        ConfigError: no such format, or its package is missing; or no picture and no format shows ``texture``.
        ValueError: an image cannot be used.
    """
    forms, layouts = forms_beside(config), [str(form) for form in config.formats if str(form) in STORES]
    if len(layouts) > 1:
        raise ConfigError(f"formats: {' and '.join(layouts)} are layouts of one file, rollout.h5; give one of them")
    for form in forms:
        _check_format(form, "formats", f"formats={forms}")
    textures = read_textures(config)
    drawn = str(config.video) != "none" or bool(config.sheet)
    if not drawn or str(config.colour) != "none":
        _check_textured(textures, forms, "formats", f"colour={config.colour} formats={forms}")


def forms_beside(config: Settings) -> list[str]:
    """The formats of files beside ``rollout.h5`` that ``hood rollout formats=[…]`` asks for."""
    return [str(form) for form in config.formats if str(form) not in STORES]


def _check_textured(textures: Mapping[str, Texture], forms: Sequence[str], key: str, asked: str) -> None:
    if textures and not any(form in _TEXTURED for form in forms):
        raise ConfigError(f"texture: {asked} shows no images; take {key}={' or '.join(_TEXTURED)}, or hood view")


def export_beside(
    source: Path, forms: Sequence[str], textures: Mapping[str, Texture], streamed: StreamedCaches | None = None
) -> list[str]:
    """Write all of the rollout ``source`` in every format beside it, in place of what an earlier run has left there.

    Args:
        textures: images of garments, of :func:`read_textures`.
        streamed: what was written while it was made; whole point caches stay as they are.

    Returns:
        A sentence about each.
    """
    if not forms:
        return []
    data = read_checked(source, "fabric")
    said = []
    for form in forms:
        there = form == "pc2" and streamed is not None and streamed.holds(data)
        said.append(_export(source, data, _beside(source, form), form, textures, _Wanted(), None if there else True))
    return said


class StreamedCaches:
    """The point caches of ``formats=[pc2]``, written while the rollout ``source`` is made.

    They have the bytes that :func:`export_beside` writes when it is over. With the layouts of ``rollout.h5`` that keep
    positions in steps it does write them, from these; and where a frame is not finite, it says so.

    Args:
        forms: the formats that are asked for; without pc2 nothing is written.
        textures: images of garments, of :func:`read_textures`.
    """

    def __init__(self, source: Path, forms: Sequence[str], textures: Mapping[str, Texture]) -> None:
        self._source, self._textures = source, textures
        self._files: PointCacheFiles | None = None
        self._ended = "pc2" not in forms

    def append(self, cloth_pos: np.ndarray, body_pos: np.ndarray) -> None:
        """Write the last frame of ``source``, whose positions (V, 3) and (W, 3) [m] these are; before the first one, and where
        they need another origin, all frames that are there.

        Raises:
            OSError: the disk refuses.
        """
        if self._ended or (self._files is not None and self._files.append(cloth_pos, body_pos)):
            return
        self.close()
        if not (np.isfinite(cloth_pos).all() and np.isfinite(body_pos).all()):
            self._ended = True
            return
        data, target = read_checked(self._source, "fabric"), _beside(self._source, "pc2")
        _write(target, "pc2", clip_of(data, textures=lay_on(self._textures, [data])[0]), _Wanted(), replace=True)
        self._files = PointCacheFiles(target, data)

    def holds(self, data: RolloutData) -> bool:
        """Whether the files hold all of ``data``, as they are to be."""
        whole = self._files is not None and not self._ended and self._files.num_frames == len(data.time)
        return whole and str(data.attributes.get("store", "")) == ""

    def close(self) -> None:
        """Close the files."""
        if self._files is not None:
            self._files.close()


def _export(
    source: Path,
    data: RolloutData,
    target: Path,
    form: str,
    textures: Mapping[str, Texture],
    wanted: _Wanted,
    replace: bool | None = False,
) -> str:
    """Write one format, but for ``replace=None``, where it is there; what there is to say of it."""
    layers = None if wanted.thickness == 0 else layer_distances(data, wanted.thickness)
    try:
        clip = clip_of(data, wanted.parts, wanted.num_frames, wanted.up, lay_on(textures, [data])[0], layers)
        if replace is not None:
            _write(target, form, clip, wanted, replace)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error
    names = ", ".join(f"{part.name} ({part.pos.shape[1]} vertices)" for part in clip.parts)
    frames = f"{clip.num_frames} frames at {clip.fps:g} fps"
    text = f"{target}: {_megabytes(target):.1f} MB, {frames}, metres, {wanted.up} up: {names}"
    if layers is not None:
        text += f"\ncloth {_millimetres(layers.sum(axis=1))} thick, closed shells"
    if clip.origin.any() and form in _FOLDERS:
        x, y, z = clip.origin.tolist()
        text += f"\nfar from the origin: positions are from ({x:g}, {y:g}, {z:g}) m; move the objects there"
    return text


class _Wanted(NamedTuple):
    """What of a rollout is written, and how."""

    parts: Sequence[str] = PARTS
    num_frames: int | None = None
    up: str = "y"
    thickness: float | None = 0.0  # m of the cloth; None: that of its fabrics
    velocities: bool = False  # of glb


def _millimetres(thickness: np.ndarray) -> str:
    """What of the cloth is not 0, in words."""
    low, high = (1e3 * edge(thickness[thickness > 0], initial=initial) for edge, initial in ((np.min, np.inf), (np.max, 0.0)))
    return f"{low:.3g} mm" if low == high else f"{low:.3g} to {high:.3g} mm"


def _checked(config: DictConfig) -> tuple[str, _Wanted]:
    """Format, and what is written."""
    form, up = str(config.format), str(config.up)
    _check_format(form, "format", f"format={form}")
    require_choice(config, "up", ("y", "z"))
    if form == "glb" and up != "y":
        raise ConfigError("up=z: glTF has y up always, and programs turn it themselves; leave up= out")
    parts = plain(config.parts)
    parts = parts if isinstance(parts, list) else [parts]
    if not parts or any(part not in PARTS for part in parts):
        raise ConfigError(f"parts={plain(config.parts)}: give some of [cloth,body]")
    return form, _Wanted(parts, frame_count(config), up, _thickness(config), _velocities(config, form))


def _velocities(config: DictConfig, form: str) -> bool:
    """Whether glb has velocities; usd always has them."""
    if not isinstance(config.velocities, bool):
        raise ConfigError(f"velocities={shown(config.velocities)}: give true or false")
    if config.velocities and form not in _SUFFIXES:
        raise ConfigError(f"velocities=true: format={form} holds positions alone; take format={' or '.join(_SUFFIXES)}")
    return bool(config.velocities)


def _thickness(config: DictConfig) -> float | None:
    """Thickness [m] of the cloth in the file; None: that of its fabrics."""
    value = config.thickness
    if value in ("none", "auto"):
        return 0.0 if value == "none" else None
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value <= _THICKEST:
        raise ConfigError(
            f"thickness={shown(value)}: give none, auto (what the fabrics have), or metres above 0, at most {_THICKEST:g}, "
            "e.g. thickness=0.001"
        )
    return float(value)


def _check_format(form: str, key: str, asked: str) -> None:
    if form.lower() in ("abc", "alembic"):
        raise ConfigError(f"{asked}: Alembic is not written (Python has no official package); take {key}=usd: they read it too")
    if form not in FORMATS:
        layouts = STORES[1:] if key == "formats" else ()
        raise ConfigError(f"{asked}: choose {' or '.join([*FORMATS, *layouts])}")
    if form == "usd" and not has_usd():
        raise ConfigError(f"{asked}: writing {NO_USD}; glb, pc2, mdd, obj and ply need nothing more")


def exports_beside(source: Path) -> list[Path]:
    """What :func:`export_beside` has written beside a rollout, in any format, and images that belong to it."""
    made = [_beside(source, form) for form in FORMATS]
    return [*(path for path in made if path.exists()), *source.parent.glob(f"{source.stem}_*_texture.*")]


def _beside(source: Path, form: str) -> Path:
    return source.with_suffix(f".{form}") if form in _SUFFIXES else source.with_name(f"{source.stem}_{form}")


def _target(config: Settings, source: Path, form: str) -> Path:
    """File or folder to write."""
    if config.output is None:
        target = _beside(source, form)
    else:
        target = Path(str(config.output)).expanduser()
    if form in _SUFFIXES:
        if target.suffix.lower() not in _SUFFIXES[form] or target.is_dir():
            raise ConfigError(f"output={target}: name a file that ends in {' or '.join(_SUFFIXES[form])}")
    elif target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise ConfigError(f"output={target}: is there already; name a folder that is new or empty")
    return target


def _write(target: Path, form: str, clip: Clip, wanted: _Wanted, replace: bool = False) -> None:
    """Write the whole, or nothing; a folder that is not empty only to ``replace`` it."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if form == "glb":
        write_atomically(target, gltf_bytes(clip, wanted.velocities))
        return
    draft = target.with_name(f".partial.{target.name}")  # USD tells the format by the suffix
    remove_whole(draft)
    try:
        if form == "usd":
            write_usd(draft, clip, wanted.up, target.name)
            for part in clip.parts:
                if part.texture is not None:
                    write_atomically(target.with_name(image_name(target.stem, part)), part.texture.content)
        else:
            draft.mkdir()
            _FOLDERS[form](draft, clip)
            if replace:
                remove_whole(target)
            elif target.is_dir():
                target.rmdir()  # empty
        draft.replace(target)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(target)) from error
    finally:
        remove_whole(draft)


def remove_whole(path: Path) -> None:
    """Remove a file, or a folder with what is in it; of a link the link alone."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _megabytes(target: Path) -> float:
    files = [target] if target.is_file() else list(target.iterdir())
    return sum(file.stat().st_size for file in files) / 1e6


def read_checked(path: Path, colour: str) -> RolloutData:
    """A rollout that can be drawn in ``colour``.

    Raises:
        ValueError: it cannot, or the file is none.
    """
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; give the rollout.h5 of hood rollout, or its folder")
    data = read_rollout(path)
    sizes = {len(data.time), len(data.cloth_pos), len(data.body_pos)}
    meshes = ((data.cloth_pos, data.cloth_faces, "cloth"), (data.body_pos, data.body_faces, "body"))
    for pos, faces, which in meshes:
        if pos.ndim != 3 or pos.shape[2] != 3 or len(sizes) > 1:
            raise ValueError(f"{path}: not a rollout file ({which}/pos has the shape {pos.shape}); make one with hood rollout")
        if faces.ndim != 2 or faces.shape[1] != 3 or (faces.size and not 0 <= faces.min() <= faces.max() < pos.shape[1]):
            raise ValueError(f"{path}: not a rollout file ({which}/faces name vertices that are not there)")
    if len(data.time) == 0:
        raise ValueError(f"{path}: holds no frames; run hood rollout again")
    if colour == "rg" and "rg" not in data.fields:
        raise ValueError(f"{path}: colour=rg needs cloth/rg, which is missing; simulate it with metrics={{fields:[rg]}}")
    if colour == "contact" and not len(data.body_faces):
        raise ValueError(f"{path}: colour=contact shows the distance from the body, and the rollout has none")
    return data


_NAMES = ("summary.json", "contact_sheet.png", "rollout.mp4", "rollout.gif", "rollout_png", "plan.json")


def remove_earlier(folder: Path, config: Settings, goes_on: bool = False) -> None:
    """Remove summary, pictures, exports, plan and state of the rollout that was in ``folder``: they would pass for the next
    one's. Of one that ``goes_on`` the state and the point caches stay.

    The summary goes first: its presence says that everything is there. What ``config`` names as input stays.
    """
    given = {Path(word).expanduser().resolve() for word in _words(plain(config))}
    source = folder / "rollout.h5"
    kept = {folder / STATE, _beside(source, "pc2")} if goes_on else set()
    for path in (*(folder / name for name in _NAMES), *exports_beside(source), folder / STATE):
        if path.resolve() not in given and path not in kept:
            remove_whole(path)


def _words(value: Any) -> Iterator[str]:
    """All strings in a value of a config."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, (dict, list)):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _words(item)


#: The one image of all garments.
_EVERY = ""


def read_textures(config: Settings) -> dict[str, Texture]:
    """The images that ``config.texture`` names, by garment; empty where it names none.

    Raises:
        ConfigError: it is neither a file nor a table of garments and files.
        FileNotFoundError: a file is not there.
        ValueError: a file is no image that can be used.
    """
    value = plain(config.texture)
    if value is None:
        return {}
    table = value if isinstance(value, dict) else {_EVERY: value}
    if not table or not all(isinstance(file, str) and file for file in table.values()):
        raise ConfigError(
            f"texture={value}: give an image, texture=plaid.png, or one a garment, texture={{tank:a.png,skirt:b.png}}"
        )
    return {str(name): read_texture(Path(file).expanduser()) for name, file in table.items()}


def lay_on(textures: Mapping[str, Texture], rollouts: Sequence[RolloutData]) -> list[dict[str, Texture]]:
    """Of every rollout the images of its garments, by the names of :func:`hood.media.pieces.pieces_of`.

    Args:
        textures: of :func:`read_textures`.

    Raises:
        ValueError: no rollout has such a garment, or it has no texture coordinates.
    """
    return _laid_on_all(textures, [pieces_of(data) for data in rollouts])


def check_worn(textures: Mapping[str, Texture], garment: Garment) -> None:
    """Refuse images that :func:`lay_on` would refuse for a rollout of ``garment``, before it is made.

    Raises:
        ValueError: see there.
    """
    _laid_on_all(textures, [pieces_by(garment.name, len(garment.rest_pos), garment.faces, still_of(garment))])


def _laid_on_all(textures: Mapping[str, Texture], worn: Sequence[Sequence[GarmentPiece]]) -> list[dict[str, Texture]]:
    names = list(dict.fromkeys(piece.name for pieces in worn for piece in pieces))
    for name in textures:
        if name != _EVERY and plain_name(name) not in names:
            raise ValueError(f"texture: {unknown('garment', name, names)}")
    asked = {name if name == _EVERY else plain_name(name): texture for name, texture in textures.items()}
    return [_laid_on(asked, pieces) for pieces in worn]


def _laid_on(textures: Mapping[str, Texture], pieces: Sequence[GarmentPiece]) -> dict[str, Texture]:
    found = {}
    for piece in pieces:
        texture: Any = textures.get(piece.name, textures.get(_EVERY))
        if texture is None:
            continue
        if not piece.is_mapped:
            raise ValueError(
                f"texture: garment {piece.name!r} has no texture coordinates; "
                "unwrap it where it was made, save it with them, and simulate it again"
            )
        found[piece.name] = texture
    return found
