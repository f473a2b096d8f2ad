"""``hood view rollout.h5 …``: rollouts as one HTML page that turns and plays in a browser, without a network.

Film and contact sheet of a rollout, drawn while it is simulated where a processor is idle.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import select
import signal
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from omegaconf import DictConfig

from hood.app.common import frame_count, output_folder, picture_of, short_names, split_words, video_of
from hood.app.notices import Bar, say
from hood.app.output.export import forms_beside, lay_on, read_checked, read_textures
from hood.app.settings.compose import ConfigError
from hood.app.settings.rollout_settings import RolloutSettings, overrides
from hood.assets.files.atomic import write_atomically
from hood.media.video import processors
from hood.rollouts.file.reader import RolloutData, read_rollout
from hood.scene.body_motion.motion import Motion

if TYPE_CHECKING:
    from hood.media.film import Film

#: More would be too narrow to see anything.
_MOST = 4
#: Height of the page in a notebook [pixels].
_HEIGHT = 640


@dataclass(frozen=True, repr=False)
class Page:
    """A page of the viewer, whole in one file. A notebook shows it where it is the value of a cell."""

    text: str  # HTML
    target: Path  # where save() writes it
    num_frames: int  # that can be played
    most: int  # vertices of the largest mesh

    def save(self, path: str | Path | None = None) -> Path:
        """Write the page, in place of a file that is there; returns its path, by default ``output``."""
        target = self.target if path is None else Path(path).expanduser()
        target.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(target, self.text.encode())
        return target

    def __repr__(self) -> str:
        return f"Page({self.num_frames} frames, {len(self.text.encode()) / 1e6:.1f} MB)"

    def _repr_html_(self) -> str:
        """The page inside that of a notebook."""
        style = f"width:100%;height:{_HEIGHT}px;border:0"
        return f'<iframe title="hood view" style="{style}" srcdoc="{escape(self.text, quote=True)}"></iframe>'


def view(*rollouts: str | Path, **keys: Any) -> Page:
    """The page of ``hood view``: up to four rollouts to turn and play, in a notebook where it is the value of a cell.

    Args:
        rollouts: their ``rollout.h5``, or the folders of them.
        keys: those of ``hood view --help``, such as ``num_frames=30``.

    Returns:
        The page; ``save("view.html")`` writes it.

    Raises:
        ValueError, OSError: keys or files that cannot be used.

    Examples:
        >>> import hood
        >>> _ = hood.rollout(garment="tank", num_frames=3, video="none", output="outputs/tank")
        >>> hood.view("outputs/tank").save("tank.html").name
        'tank.html'
    """
    return viewer_page([*(str(Path(rollout)) for rollout in rollouts), *overrides(keys)])


def viewer_page(arguments: Sequence[str]) -> Page:
    """The page that words of ``hood view`` ask for: rollouts, and keys of configs/view.yaml.

    Raises:
        ConfigError, ValueError: words or files that cannot be used.
    """
    files, config = _split(arguments)
    count = frame_count(config)
    target = output_folder(config)
    if target.suffix.lower() not in (".html", ".htm") or target.is_dir():
        raise ConfigError(f"output={target}: name a file that ends in .html, e.g. output=view.html")
    textures = read_textures(config)
    whole = [read_checked(path, "fabric") for path in files]
    rollouts = [_first_frames(data, count) for data in whole]
    from hood.media.viewer.page import view_page

    names = short_names(files)
    title = " and ".join(names) if config.title is None else str(config.title)
    named = list(zip(names, rollouts, strict=True))
    text = view_page(named, title, lay_on(textures, rollouts), whole)
    most = max(max(data.cloth_pos.shape[1], data.body_pos.shape[1]) for data in rollouts)
    return Page(text, target, max(len(data.time) for data in rollouts), most)


def _split(arguments: Sequence[str]) -> tuple[list[Path], DictConfig]:
    """Files in their order and the config: a word of the form ``key=value`` is an override, every other word a file."""
    given, config = split_words("view", arguments)
    if not 1 <= len(given) <= _MOST:
        raise ConfigError(f"number of rollouts given: {len(given)}; give one to {_MOST}, hood view rollout.h5")
    paths = [Path(name).expanduser() for name in given]
    return [path / "rollout.h5" if path.is_dir() else path for path in paths], config


def _first_frames(data: RolloutData, count: int | None) -> RolloutData:
    if count is None:
        return data
    metrics = {name: values[:count] for name, values in data.metrics.items()}
    return replace(
        data, cloth_pos=data.cloth_pos[:count], body_pos=data.body_pos[:count], time=data.time[:count], metrics=metrics
    )


# ---- film and contact sheet of one rollout ---------------------------------------------------------------------------------


def draw(config: RolloutSettings, data: RolloutData, folder: Path, bar: Bar) -> None:
    """Film and contact sheet, when the picture libraries are installed."""
    kind, stride = video_of(config)
    if kind == "none" and not bool(config.sheet):
        return
    try:
        film = _film_of(config, data)
    except ImportError as error:
        say(f"no pictures: {error}", error=True)
        return
    chosen = range(0, len(data.cloth_pos), stride)
    _write(config, film, folder, bar(chosen, len(chosen), "video") if kind != "none" else ())


def _film_of(config: RolloutSettings, data: RolloutData) -> Film:
    from hood.media.film import Film, Shots

    asked = picture_of(config, video_of(config)[0])
    return Film(
        data,
        asked.width or 0,
        asked.height or 0,
        colour=str(config.colour),
        thinner=1e-3 * asked.thin_body,
        textures=lay_on(read_textures(config), [data])[0],
        shots=Shots.of(asked.views, asked.camera, asked.background, asked.fabric_looks),
    )


def _write(config: RolloutSettings, film: Film, folder: Path, frames: Iterable[int], busy: Callable[[], bool] = bool) -> None:
    from hood.media.film import sheet_frames, write_sheet, write_video

    (kind, stride), pictures = video_of(config), dict[int, np.ndarray]()
    if kind != "none":
        kept = sheet_frames(len(film.data.cloth_pos)) if bool(config.sheet) else ()
        path = folder / ("rollout_png" if kind == "png" else f"rollout.{kind}")
        _, pictures = write_video(film, path, frames, stride, kept, busy)
    if bool(config.sheet):
        write_sheet(film, folder / "contact_sheet.png", pictures)


#: What is sent to the process that draws: that a frame is in the file, and that it was the last one.
_FRAME, _LAST = b".", b"!"


class FilmAlongside:
    """Film and contact sheet of a rollout, drawn by a process of its own while the rollout is simulated.

    It is forked where a processor is idle, and only of a process with a single thread: locks that other threads hold would
    stay locked in it. It reads the frames in ``rollout.h5`` and knows the motion of the body beforehand, so that it knows the
    cameras where these do not depend on the cloth. Where they do, or the process ends early, the file is as if it had not been
    there, and :meth:`finish` says so.

    Args:
        config: settled.
        motion: of the body.
        count: frames of the rollout; 0: some are there already, and nothing is drawn.
        folder: where ``rollout.h5`` will be.
    """

    def __init__(self, config: RolloutSettings, motion: Motion, count: int, folder: Path) -> None:
        self._frames = range(0, count, video_of(config)[1])
        self._process: int | None = None
        self._pictures = 0  # drawn so far, as far as is known
        if not (count and _is_known_ahead(config, motion) and processors() > 1 and _has_one_thread()):
            return
        ends = list[int]()
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # neither process is to end as the other
        try:
            ends += os.pipe()
            ends += os.pipe()
            self._process = os.fork()
            if self._process == 0:
                try:
                    _become_silent({ends[0], ends[3]})
                    _draw_alongside(config, motion, count, folder, ends[0], ends[3])
                    os._exit(0)
                finally:  # nothing of the other process is run to its end here
                    os._exit(1)
        except OSError:  # no memory, no more processes, or no more files
            for end in ends:
                os.close(end)
            return
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        incoming, self._told, self._drawn, outgoing = ends
        os.close(incoming)
        os.close(outgoing)
        os.set_blocking(self._told, False)
        os.set_blocking(self._drawn, False)

    def tell(self) -> None:
        """A further frame is in the file."""
        if self._process is not None:
            with contextlib.suppress(BlockingIOError, BrokenPipeError):  # it counts the frames in the file
                os.write(self._told, _FRAME)
            with contextlib.suppress(BlockingIOError):  # so that it never waits for being heard
                self._pictures += len(os.read(self._drawn, 1 << 16))

    def finish(self, bar: Bar) -> bool:
        """Wait for the files when all frames are there; returns whether they are there."""
        if self._process is None:
            return False
        os.set_blocking(self._told, True)
        os.set_blocking(self._drawn, True)
        with contextlib.suppress(BrokenPipeError):
            os.write(self._told, _LAST)
        for _ in bar(self._each_picture(), len(self._frames), "video"):
            pass
        return self.close() == 0

    def _each_picture(self) -> Iterator[int]:
        yield from range(self._pictures)
        while done := os.read(self._drawn, 4096):
            yield from done

    def close(self) -> int | None:
        """End the process; returns its exit code, None where there is none."""
        process, self._process = self._process, None
        if process is None:
            return None
        os.close(self._told)
        os.close(self._drawn)
        try:
            return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        except ChildProcessError:  # the system was told to forget them: how it ended is not known
            return None


def _is_known_ahead(config: RolloutSettings, motion: Motion) -> bool:
    """Whether there is a film, and nothing but its cameras depends on frames to come."""
    kind = video_of(config)[0]
    encoded = kind != "mp4" or importlib.util.find_spec("imageio_ffmpeg") is not None
    stored = config.output_fps is None and forms_beside(config) == list(config.formats)  # frame by frame, as they are
    return kind != "none" and encoded and stored and str(config.colour) == "none" and motion.num_vertices > 0


def _has_one_thread() -> bool:
    try:
        return len(os.listdir("/proc/self/task")) == 1
    except OSError:  # only Linux says so
        return False


def _become_silent(kept: Collection[int]) -> None:
    """Leave to the other process what is its own: its files with their locks, the keyboard, and all that is said."""
    for name in os.listdir("/proc/self/fd"):
        if int(name) > 2 and int(name) not in kept:
            with contextlib.suppress(OSError):
                os.close(int(name))
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):  # it ends when the other one has
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    nowhere = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(3):
        os.dup2(nowhere, descriptor)


#: Frames of the body that are posed at once.
_POSED = 64


def _draw_alongside(config: RolloutSettings, motion: Motion, count: int, folder: Path, incoming: int, outgoing: int) -> None:
    """The work of the process: all files, or an exception and none.

    Raises:
        EOFError: the other process has gone.
        ValueError: there are fewer frames, or other cameras see them.
    """
    posed = [motion.some_points(np.arange(first, min(first + _POSED, count)), 1) for first in range(0, count, _POSED)]
    arriving = _Arriving(folder / "rollout.h5", incoming, posed)
    posed.clear()
    film = _film_of(config, arriving.data)

    def same_cameras() -> bool:
        return film.sees_as(_film_of(config, arriving.data))

    def frames(beside: ThreadPoolExecutor) -> Iterator[int]:
        alike: Future[bool] | None = None
        for index in [*range(0, count, video_of(config)[1]), count]:
            arriving.wait(index)
            if arriving.ended and alike is None:
                alike = beside.submit(same_cameras)
            if alike is not None and (index == count or alike.done()) and not alike.result():
                raise ValueError("the cameras depend on the cloth")
            if index < count:
                yield index
                os.write(outgoing, _FRAME)

    with ThreadPoolExecutor(1) as beside:
        _write(config, film, folder, frames(beside), lambda: not arriving.ended)


class _Arriving:
    """The rollout whose frames come into a file; those to come have the body where it will be, and no cloth.

    Args:
        path: of the file.
        descriptor: where the other process says what is in it.
        body: (N, W, 3) m, one behind the other, all frames.
    """

    def __init__(self, path: Path, descriptor: int, body: Sequence[np.ndarray]) -> None:
        self._path, self._descriptor, self.ended, self._there = path, descriptor, False, 0
        self._hear(None)
        data = read_rollout(path)
        pos = np.concatenate(body, dtype=data.body_pos.dtype, casting="same_kind")
        cloth = np.full((len(pos), *data.cloth_pos.shape[1:]), np.nan, dtype=data.cloth_pos.dtype)
        time = np.arange(len(pos)) * float(data.attributes["dt"])
        self.data = replace(data, cloth_pos=cloth, body_pos=pos, time=time)

    def wait(self, index: int) -> None:
        """Until the frame is there, or the rollout has ended and all of its frames are."""
        self._hear(0.0)
        while not self.ended and self._there <= index:
            self._read()
            if self._there <= index:
                self._hear(None)
        if self.ended and self._there < len(self.data.time):
            self._read()
            if self._there < len(self.data.time):
                raise ValueError("the rollout ended early")

    def _read(self) -> None:
        with h5py.File(self._path, "r") as file:
            new = slice(self._there, int(file.attrs["num_frames"]))
            self.data.cloth_pos[new], self.data.body_pos[new] = file["cloth/pos"][new], file["body/pos"][new]
            self._there = new.stop

    def _hear(self, seconds: float | None) -> None:
        """What was said; None waits for it."""
        if select.select([self._descriptor], [], [], seconds)[0]:
            said = os.read(self._descriptor, 1 << 16)
            if not said:
                raise EOFError
            self.ended |= said.endswith(_LAST)
