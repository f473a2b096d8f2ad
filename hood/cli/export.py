"""``hood export``: a rollout as files that other programs open.

``hood view rollout.h5 …``: rollouts as one HTML page that turns and plays in a browser, without a network.

``hood convert``: published HOOD weights in, a model file of this project out; or a model file at half its size. Rollouts of
the published code in, ``rollout.h5`` out, and back.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from omegaconf import DictConfig

from hood.app.batch.manifest import UNJUDGED, Manifest
from hood.app.common import prepare_folder
from hood.app.output.export import export, remove_whole
from hood.app.output.view import viewer_page
from hood.app.settings.compose import ConfigError, load_config, plain
from hood.assets.files.atomic import write_atomically
from hood.assets.files.library import locate
from hood.rollouts.file.dataset import RolloutDataset
from hood.rollouts.file.reader import published_bytes, read_published, read_rollout, write_rollout
from hood.steppers.checkpoint import CAUTION, load_simulator, read_header, save_simulator
from hood.steppers.published import SUFFIXES, read_reference_checkpoint

if TYPE_CHECKING:
    from hood.steppers.network import NetworkStepper

_MODEL = ".safetensors"
_PICKLES = (".pkl", ".pickle")
#: A page beyond this [bytes] is slow to send and to open.
_HEAVY = 12_000_000


def run(arguments: Sequence[str]) -> int:
    """Run the command ``export``; returns the exit code."""
    _, said = export(arguments)
    print("\n".join(said))
    return 0


def convert(overrides: Sequence[str]) -> int:
    """Run the command ``convert``; returns the exit code."""
    config = load_config("convert", overrides)
    if config.rollout is not None:
        return _convert_rollouts(config)
    if config.fps is not None:
        raise ConfigError(f"fps={config.fps}: is of rollout=walk.pkl; leave it out")
    source, target = _paths(config)
    simulator, header = _read(source)
    if config.caution is not None:
        simulator.caution = " ".join(str(config.caution).split())
        header.pop(CAUTION, None)
    prepare_folder(target.parent)
    save_simulator(target, simulator, header, half=bool(config.half))
    count = sum(parameter.numel() for parameter in simulator.parameters())
    print(f"{source}: {header.get('layout', 'native')} weights, {len(simulator.schedule)} steps, {count} parameters")
    print(f"written to {target}" + (f" in float16, weights changed by {_change(simulator, target):.1e}" if config.half else ""))
    return 0


def _read(source: Path) -> tuple[NetworkStepper, dict[str, str]]:
    """The model and what its file will say about where it comes from."""
    if source.suffix == _MODEL:
        return load_simulator(source), read_header(source)
    simulator, layout = read_reference_checkpoint(source)
    digest = hashlib.sha256(source.read_bytes()).hexdigest()
    return simulator, {"source": source.name, "source_sha256": digest, "layout": layout}


@torch.no_grad()
def _change(simulator: NetworkStepper, path: Path) -> float:
    """The root of the mean square change of the weights in the file over that of the weights."""
    written = dict(load_simulator(path).named_parameters())
    change = sum(float((written[name] - value).square().sum()) for name, value in simulator.named_parameters())
    return (change / sum(float(value.square().sum()) for value in simulator.parameters())) ** 0.5


def _paths(config: DictConfig) -> tuple[Path, Path]:
    """File to read and file to write."""
    if config.checkpoint is None:
        raise ConfigError(
            "checkpoint is not given: hood convert checkpoint=weights.pth output=weights.safetensors, or rollout=walk.pkl"
        )
    source = locate("weights", str(config.checkpoint))
    if source.suffix == _MODEL and not config.half and config.caution is None:
        raise ConfigError(
            f"{source}: is a model file already; give published weights ({', '.join(SUFFIXES)}), "
            "or half=true output=small.safetensors, or a caution for its users"
        )
    if source.suffix == _MODEL and config.output is None:
        raise ConfigError(f"output is not given: where the copy of {source} goes, e.g. output=small.safetensors")
    target = source.with_suffix(_MODEL) if config.output is None else Path(str(config.output)).expanduser()
    if target.suffix != _MODEL:
        raise ConfigError(f"output={target}: model files end in {_MODEL}")
    return source, target


def write_page(arguments: Sequence[str]) -> int:
    """Run the command ``view``; returns the exit code."""
    page = viewer_page(arguments)
    size, target = len(page.text.encode()), page.save()
    print(f"{target}: {size / 1e6:.1f} MB, {page.num_frames} frames; open it in a browser")
    if size > _HEAVY and page.num_frames > 1:
        fewer = max(int(page.num_frames * _HEAVY / size), 1)
        mesh = f"of up to {page.most:,} vertices a mesh"
        print(f"that is a heavy page, {mesh}: num_frames={fewer} keeps it below {_HEAVY / 1e6:g} MB")
    return 0


# ---- rollouts --------------------------------------------------------------------------------------------------------


def _convert_rollouts(config: DictConfig) -> int:
    for key, usual in (("checkpoint", None), ("caution", None), ("half", False)):
        if config[key] != usual:
            raise ConfigError(f"{key}={config[key]}: is of a model, rollout={config.rollout} is none; leave one out")
    fps, source = config.fps, Path(str(config.rollout)).expanduser()
    if fps is not None and (isinstance(fps, bool) or not isinstance(fps, (int, float)) or not 0 < fps < 1e6):
        raise ConfigError(f"fps={fps}: give frames per second, a number above 0")
    sources = _rollouts_in(source, plain(config.verdict))
    if fps is not None and sources[0].suffix not in _PICKLES:
        raise ConfigError(f"fps={fps}: {sources[0]} says its frame rate itself; leave it out")
    many = source.is_dir() and sources != [source / "rollout.h5"]
    target = _target(config, sources[0], many)
    with _new(target) as draft:
        if not many:
            _convert_one(sources[0], draft, fps)
        for one in sources if many else ():
            place = one.relative_to(source)
            if one.suffix in _PICKLES:
                row = place.with_suffix("")
                frames = _convert_one(one, draft / row / "rollout.h5", fps)
                line = {"row": row.as_posix(), "verdict": UNJUDGED, "settings": {}, "stored_frames": frames}
                Manifest(draft).append(line)
            else:
                _convert_one(one, draft / f"{place.parent}.pkl", fps)
    print(f"written to {target}" + (f": {len(sources)} rollouts" if many else ""))
    return 0


def _rollouts_in(source: Path, verdict: Sequence[str]) -> list[Path]:
    """The files that a file or folder stands for."""
    if not source.exists():
        raise FileNotFoundError(f"{source}: no such file; give a .pkl, a rollout.h5, or a folder of these")
    if source.is_file():
        if source.suffix not in (*_PICKLES, ".h5"):
            raise ConfigError(f"rollout={source}: give a .pkl of the published code, or a rollout.h5")
        return [source]
    if (source / "manifest.jsonl").exists():
        names = RolloutDataset(source, window=1, verdict=verdict).names
        return [source / name / "rollout.h5" for name in names]
    if (source / "rollout.h5").exists():
        return [source / "rollout.h5"]
    found = sorted(path for path in source.rglob("*") if path.suffix in _PICKLES)
    twice = next((a for a, b in pairwise(found) if a.with_suffix("") == b.with_suffix("")), None)
    if twice is not None:
        raise ConfigError(f"{twice}: another pickle beside it has this name; rename one")
    if not found:
        raise ConfigError(
            f"rollout={source}: has no manifest.jsonl of hood dress, no rollout.h5 and no .pkl; name another folder"
        )
    return found


def _target(config: DictConfig, first: Path, many: bool) -> Path:
    """File or folder to write, which is not there."""
    form = ".h5" if first.suffix in _PICKLES else ".pkl"
    if config.output is None and many:
        raise ConfigError(f"output is not given: the folder for the files of rollout={config.rollout}")
    target = first.with_suffix(form) if config.output is None else Path(str(config.output)).expanduser()
    if not many and target.suffix != form:
        raise ConfigError(f"output={target}: name a file that ends in {form}")
    if target.exists() and not (many and target.is_dir() and not any(target.iterdir())):
        raise ConfigError(f"output={target}: is there already; name {'a folder' if many else 'a file'} that is new")
    return target


def _convert_one(source: Path, target: Path, fps: float | None) -> int:
    """Write one rollout in the other layout; how many frames it has."""
    if source.suffix in _PICKLES:
        data, said = read_published(source, fps)
        print("".join(f"{sentence}\n" for sentence in said), end="")
        write_rollout(prepare_folder(target.parent) / target.name, data)
    else:
        data = read_rollout(source)
        if not bool(data.attributes.get("complete", True)):
            print(f"{source}: is not finished; {len(data.time)} of {data.attributes.get('num_planned', '?')} frames are there")
        content = published_bytes(source, data)
        write_atomically(prepare_folder(target.parent) / target.name, content)
    print(f"{source}: {len(data.time)} frames of {data.cloth_pos.shape[1]} vertices, {1 / data.attributes['dt']:g} fps")
    return len(data.time)


@contextmanager
def _new(target: Path) -> Iterator[Path]:
    """A place beside ``target`` for what takes its name when it is whole, and is removed where it does not become so."""
    draft = target.with_name(f".partial.{target.name}")
    remove_whole(draft)
    try:
        yield draft
        if target.is_dir():
            target.rmdir()  # empty
        draft.replace(target)
    except OSError as error:
        named = str(error.filename or "").startswith(str(draft))
        raise (OSError(error.errno, error.strerror, str(target)) if named else error) from error
    finally:
        remove_whole(draft)
