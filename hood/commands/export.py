"""``hood export rollout.h5 format=usd``: a rollout as files that other programs open."""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from omegaconf import DictConfig

from hood.assets.files.atomic import write_atomically
from hood.commands.common import frame_count, split_words
from hood.commands.compare import read_checked
from hood.config import ConfigError, plain, require_choice
from hood.media.exports.clip import PARTS, Clip, clip_of
from hood.media.exports.gltf import gltf_bytes
from hood.media.exports.sequences import write_obj_sequence, write_ply_sequence, write_point_cache
from hood.media.exports.usd import write_usd

_SUFFIXES = {"usd": (".usd", ".usdc", ".usda"), "glb": (".glb",)}
_FOLDERS: dict[str, Callable[[Path, Clip], None]] = {
    "pc2": write_point_cache,
    "obj": write_obj_sequence,
    "ply": write_ply_sequence,
}


def run(arguments: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    files, config = split_words("export", arguments)
    if len(files) != 1:
        raise ConfigError(f"{len(files)} rollouts are given, one can be exported: hood export rollout.h5")
    source = Path(files[0]).expanduser()
    source = source / "rollout.h5" if source.is_dir() else source
    count = frame_count(config)
    form, up, parts = _checked(config)
    target = _target(config, source, form)
    data = read_checked(source, "fabric")
    try:
        clip = clip_of(data, parts, count, up)
        _write(target, form, clip, up)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error
    names = ", ".join(f"{part.name} ({part.pos.shape[1]} vertices)" for part in clip.parts)
    print(f"{target}: {_megabytes(target):.1f} MB, {clip.num_frames} frames at {clip.fps:g} fps, metres, {up} up: {names}")
    if clip.origin.any() and form in _FOLDERS:
        x, y, z = clip.origin.tolist()
        print(f"far from the origin: positions are from ({x:g}, {y:g}, {z:g}) m; move the objects there")
    if not bool(data.attributes.get("complete", True)):
        print(f"the rollout is not finished: {len(data.time)} of {data.attributes.get('num_planned', '?')} frames are there")
    return 0


def _checked(config: DictConfig) -> tuple[str, str, list[str]]:
    """Format, axis that points up, and parts."""
    form, up = str(config.format), str(config.up)
    if form == "abc":
        raise ConfigError("format=abc: no maintained package writes Alembic; take format=usd, which the same programs read")
    require_choice(config, "format", ("usd", "glb", *_FOLDERS))
    require_choice(config, "up", ("y", "z"))
    if form == "glb" and up != "y":
        raise ConfigError("up=z: glTF has y up always, and programs turn it themselves; leave up= out")
    if form == "usd" and importlib.util.find_spec("pxr") is None:
        raise ConfigError(
            'format=usd: writing needs usd-core (pip install "hood[usd]"); glb, pc2, obj and ply need nothing more'
        )
    parts = plain(config.parts)
    parts = parts if isinstance(parts, list) else [parts]
    if not parts or any(part not in PARTS for part in parts):
        raise ConfigError(f"parts={plain(config.parts)}: give some of [cloth,body]")
    return form, up, parts


def _target(config: DictConfig, source: Path, form: str) -> Path:
    """File or folder to write."""
    if config.output is None:
        target = source.with_suffix(f".{form}") if form in _SUFFIXES else source.with_name(f"{source.stem}_{form}")
    else:
        target = Path(str(config.output)).expanduser()
    if form in _SUFFIXES:
        if target.suffix.lower() not in _SUFFIXES[form] or target.is_dir():
            raise ConfigError(f"output={target}: name a file that ends in {' or '.join(_SUFFIXES[form])}")
    elif target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise ConfigError(f"output={target}: is there already; name a folder that is new or empty")
    return target


def _write(target: Path, form: str, clip: Clip, up: str) -> None:
    """Write the whole, or nothing."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if form == "glb":
        write_atomically(target, gltf_bytes(clip))
        return
    draft = target.with_name(f".partial.{target.name}")  # USD tells the format by the suffix
    _remove(draft)
    try:
        if form == "usd":
            write_usd(draft, clip, up)
        else:
            draft.mkdir()
            _FOLDERS[form](draft, clip)
            if target.is_dir():
                target.rmdir()  # empty
        draft.replace(target)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(target)) from error
    finally:
        _remove(draft)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _megabytes(target: Path) -> float:
    files = [target] if target.is_file() else list(target.iterdir())
    return sum(file.stat().st_size for file in files) / 1e6
