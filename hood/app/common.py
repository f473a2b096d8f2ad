"""What the commands share: the output folder, the device, the word for random weights."""

from __future__ import annotations

import importlib.util
import os
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import torch
from omegaconf import DictConfig

from hood.app.settings.compose import SWEEP_FLAGS, ConfigError, brief, load_config, plain, require_choice
from hood.app.settings.rollout_settings import PictureSettings, Settings
from hood.assets.files.atomic import occupy
from hood.assets.files.said import install, say
from hood.model.kernels.block import check_kernels, why_slow
from hood.model.network.kernel_choice import AUTO, KernelChoice, choose_for
from hood.steppers.checkpoint import load_simulator
from hood.steppers.network import NetworkStepper
from hood.steppers.newton import Stepper
from hood.steppers.published import SUFFIXES, load_reference_checkpoint
from hood.tensors.dense import check_precision
from hood.training import distributed

Result = TypeVar("Result")

#: ``checkpoint=untrained``: seeded random weights instead of a file.
UNTRAINED = "untrained"
_VIDEOS = ("mp4", "gif", "png", "none")
#: A body drawn thinner than this [mm] is another body.
_THINNEST = 20.0


class GivenUpError(Exception):
    """A process that torchrun started ends, and has said why."""


def together(command: Callable[[], Result], timeout: timedelta = distributed.BATCH_TIMEOUT) -> Result:
    """Run a command that torchrun may have started several times; an error of process 0 that ends all is told once. No process
    waits longer than ``timeout`` for another.

    Raises:
        GivenUpError: instead of another process's ValueError, OSError or ImportError.
    """
    distributed.start(timeout)
    try:
        return command()
    except (ValueError, OSError, ImportError) as error:
        if distributed.rank() == 0:
            raise
        if not distributed.is_told(error):
            say(f"hood: process {distributed.rank()}: {error}", error=True)
        raise GivenUpError(str(error)) from error
    finally:
        distributed.stop()


def split_words(command: str, arguments: Sequence[str]) -> tuple[list[str], DictConfig]:
    """Files of a command that takes files, in their order, and its config: a word of the form ``key=value`` is an override,
    every other word a file.

    Raises:
        ConfigError: a word begins like an option, or a key or value is unknown.
    """
    overrides = [word for word in arguments if ("=" in word and not Path(word).exists()) or word in SWEEP_FLAGS]
    given = [word for word in arguments if word not in overrides]
    strange = next((word for word in given if word.startswith("-")), None)
    if strange is not None:
        raise ConfigError(f"unknown option {strange!r}; write key=value, see hood {command} --help")
    return given, load_config(command, overrides)


def frame_count(config: DictConfig) -> int | None:
    """``config.num_frames`` of a command that shows frames of a rollout: the first so many; None: all.

    Raises:
        ConfigError: no whole number above 0.
    """
    count = config.num_frames
    if count is not None and (isinstance(count, bool) or not isinstance(count, int) or count < 1):
        raise ConfigError(f"num_frames={count}: must be a whole number, at least 1")
    return None if count is None else int(count)


def video_of(config: Settings) -> tuple[str, int]:
    """What ``video`` of a rollout says: mp4, gif, png or none, and of how many frames one is drawn.

    Raises:
        ConfigError: it says something else.
    """
    value = plain(config.video)
    if not isinstance(value, list):
        require_choice(config, "video", _VIDEOS)
        return str(value), 1
    if len(value) != 2 or value[0] not in _VIDEOS[:-1] or type(value[1]) is not int or value[1] < 1:
        raise ConfigError(f"video={brief(value)}: give mp4, gif or png, and every how many frames, such as video=[mp4,3]")
    return str(value[0]), value[1]


def output_folder(config: Settings) -> Path:
    """The folder that ``config.output`` names; nothing is made yet.

    Raises:
        ConfigError: it names none.
    """
    if config.output is None or not str(config.output):
        raise ConfigError("output: no folder is named; give one, e.g. output=outputs/mine")
    return Path(str(config.output)).expanduser()


def require_package(module: str, title: str, extra: str, what: str) -> None:
    """Raise ConfigError unless ``module`` is there, before ``what`` is begun that draws with it."""
    if importlib.util.find_spec(module) is None:
        raise ConfigError(f"{what}: drawing needs {title} ({install(extra)})")


def require_distinct(key: str, values: Sequence[Any]) -> None:
    """Raise ConfigError where one of ``values`` is given twice: it would be computed twice."""
    twice = next((value for place, value in enumerate(values) if value in values[:place]), None)
    if twice is not None:
        raise ConfigError(f"{key}: {twice!r} is given twice; leave one out")


def thinning(config: DictConfig) -> float:
    """[m] of ``config.thin_body`` of a command that has it as a key, which is in millimetres.

    Raises:
        ConfigError: it is no such number.
    """
    value = config.thin_body
    is_right, fix = _PARTS["thin_body"]
    if not is_right(value):
        raise ConfigError(f"thin_body={value}: give {fix}")
    return 1e-3 * float(value)


def picture_of(config: Settings, film: str = "mp4") -> PictureSettings:
    """What ``picture`` says of films of a kind, with their width and height, and numbers within their bounds.

    Raises:
        ConfigError: a part of it is unknown, or has a value that it cannot have.
    """
    usual, value = PictureSettings(), plain(config.picture)
    table = {} if value is None else value if isinstance(value, dict) else None
    if table is None:
        raise ConfigError(f"picture={brief(value)}: give a table, {{height:1080}}, of {', '.join(usual._fields)}")
    strange = next((name for name in table if name not in usual._fields), None)
    if strange is not None:
        raise ConfigError(f"picture={brief(value)}: {strange!r} is no part of it; give some of {', '.join(usual._fields)}")
    parts: dict[str, Any] = {name: tuple(part) if isinstance(part, list) else part for name, part in table.items()}
    given = usual._replace(**parts)
    views = given.views if isinstance(given.views, tuple) else (given.views,)
    given = given._replace(views=views)
    for name, (is_right, fix) in _PARTS.items():
        if name in table and not is_right(getattr(given, name)):
            raise ConfigError(f"picture={brief(value)}: {name}={brief(table[name])}; give {fix}")
    width, height = (640, 360) if film == "gif" else (1280, 720)
    if given.width is None and given.height is not None:  # one of them: the other in proportion, and even
        width, height = 2 * round(given.height * width / height / 2), given.height
    elif given.width is not None:
        width, height = given.width, given.height or 2 * round(given.width * height / width / 2)
    if width < _LEAST_VIEW * len(views):
        raise ConfigError(f"picture={brief(value)}: width={width} is too small for {len(views)} views of {_LEAST_VIEW} pixels")
    background = given.background or ("transparent" if film == "png" else "studio")
    if background == "transparent" and film != "png":
        raise ConfigError(f"picture={brief(value)}: video={film} cannot be transparent; add video=png, or give a colour")
    return given._replace(width=width, height=height, background=background)


def _is_size(value: Any) -> bool:
    return value is None or (type(value) is int and 64 <= value <= 4096 and value % 2 == 0)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _is_view(value: Any) -> bool:
    return value in _VIEWS if isinstance(value, str) else _is_number(value) and abs(value) <= 360


def _is_background(value: Any) -> bool:
    if isinstance(value, tuple):
        return len(value) == 3 and all(type(part) is int and 0 <= part <= 255 for part in value)
    return value in (None, "studio", "transparent")


_VIEWS = ("front", "side", "back", "turntable")
_LEAST_VIEW = 64  # pixels
_PIXELS = "an even number of pixels, 64 to 4096"
#: Of parts of ``picture``: whether a value is right, and what is.
_PARTS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "width": (_is_size, _PIXELS),
    "height": (_is_size, _PIXELS),
    "views": (
        lambda views: 1 <= len(views) <= 4 and all(map(_is_view, views)),
        f"one to four of {', '.join(_VIEWS)}, or degrees",
    ),
    "camera": (lambda value: value in ("follow", "fixed", "orbit"), "follow, fixed or orbit"),
    "background": (_is_background, "studio, transparent, or [red,green,blue] from 0 to 255"),
    "fabric_looks": (lambda value: isinstance(value, bool), "true or false"),
    "thin_body": (
        lambda value: _is_number(value) and 0 <= value <= _THINNEST,
        f"millimetres, 0 (the body as it is) to {_THINNEST:g}",
    ),
}


def prepare_folder(folder: Path) -> Path:
    """The output folder, made and checked for writing.

    Raises:
        OSError: it cannot be made or written to.
    """
    if folder.exists() and not folder.is_dir():
        raise FileExistsError(f"output={folder}: a file of this name exists; choose another output, a folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileNotFoundError as error:  # as below /proc
        raise FileNotFoundError(f"output={folder}: the folder cannot be made there; choose another output") from error
    if not os.access(folder, os.W_OK):
        raise PermissionError(13, "Permission denied", str(folder))
    return folder


@contextmanager
def held_folder(config: Settings) -> Iterator[Path]:
    """The output folder, made, checked, and held for this run by the first of its processes
    (:mod:`hood.assets.files.atomic`).

    Raises:
        OSError: it cannot be made or written to.
        OccupiedError: another run is writing there.
    """
    folder = output_folder(config)
    with ExitStack() as stack:
        distributed.on_main(lambda: stack.enter_context(occupy(prepare_folder(folder))))
        yield folder


def load_stepper(path: Path, fps: float) -> NetworkStepper:
    """The simulator in a model file or in published HOOD weights (``.pth``), for motions at ``fps``.

    Raises:
        ConfigError: the model knows another frame rate only.
    """
    simulator = load_reference_checkpoint(path) if path.suffix.lower() in SUFFIXES else load_simulator(path)
    frame_dt = simulator.rules.frame_dt
    if frame_dt is not None and abs(fps * frame_dt - 1) > 1e-3:
        raise ConfigError(f"fps={fps:g}: {path} knows steps of 1/{1 / frame_dt:g} s only; use fps={1 / frame_dt:g}")
    return simulator


def require_same_model(
    path: Path, held: NetworkStepper, asked: NetworkStepper, way_out: str, free: Collection[str] = ()
) -> None:
    """Refuse weights of another model than the one ``asked`` for, and name the settings that differ; those ``free`` may.

    Raises:
        ConfigError: see above; ends with ``way_out``.
    """
    theirs, ours = held.config, asked.config
    keys = {*theirs, *ours} - {*free}
    different = sorted(key for key in keys if key not in theirs or key not in ours or theirs[key] != ours[key])
    if different:
        named = ", ".join(f"{key}={theirs.get(key, 'its default')}" for key in different)
        raise ConfigError(f"{path}: holds a model of {named}, not the model asked for; {way_out}")


def weigh(stepper: Stepper, config: Settings) -> None:
    """Let ``config.gravity`` [m/s²] act in the stepper's steps, on ``config.device``."""
    stepper.gravity = torch.tensor([0.0, -float(config.gravity), 0.0], device=str(config.device))


def use_arithmetic(simulator: NetworkStepper, config: Settings, traced: bool = False) -> None:
    """Let the simulator's network compute as ``config.precision`` and ``config.kernels`` say; a choice is told in one line.

    A step that is ``traced`` is torch's operations, which leaves no choice.

    Raises:
        ValueError: no such precision or kernels, or not on this device.
    """
    precision, kernels, device = str(config.precision), str(config.kernels), torch.device(str(config.device))
    network = simulator.network
    check_precision(precision, device)
    warn_if_slow("precision", precision, device)
    if kernels == AUTO and traced:
        kernels = "torch"
    if kernels == AUTO:
        choice = choose_for(network, precision, device)
        tell_choice(choice)
        kernels = choice.kernels
    check_kernels(kernels, precision, network.latent_dim, device)
    network.use_precision(precision)
    network.use_kernels(kernels)


def warn_if_slow(key: str, precision: str, device: torch.device) -> None:
    """A warning where a precision that should save time costs some here."""
    reason = why_slow(precision, device)
    if reason and distributed.rank() == 0:
        warnings.warn(f"{key}={precision}: {reason}", stacklevel=2)


@cache
def tell_choice(choice: KernelChoice) -> None:
    """Say what ``kernels=auto`` has chosen, once."""
    if distributed.rank() == 0:
        say(choice)


def require_device(config: Settings) -> None:
    """Raise ConfigError unless ``config.device`` is known and present; with ``cuda`` this process takes the GPU of its rank.

    Raises:
        ConfigError: no GPU, or torchrun started more processes on this machine than it has GPUs.
    """
    require_choice(config, "device", ("cpu", "cuda"))
    if str(config.device) != "cuda":
        return
    if not torch.cuda.is_available():
        raise ConfigError("device=cuda: no CUDA device is available; use device=cpu")
    gpus, processes = torch.cuda.device_count(), distributed.local_world_size()
    if processes > gpus:
        raise ConfigError(f"device=cuda: {processes} processes and {gpus} GPU{'s' * (gpus > 1)} here; --nproc-per-node {gpus}")
    torch.cuda.set_device(distributed.local_rank())


def short_names(paths: Sequence[Path]) -> list[str]:
    """The shortest ends of the paths that tell them apart, ``rollout.h5`` left out."""
    parts = [path.absolute().parent.parts + (() if path.name == "rollout.h5" else (path.stem,)) for path in paths]
    for length in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-length:]) for part in parts]
        if len(set(names)) == len(set(parts)):
            break
    return names
