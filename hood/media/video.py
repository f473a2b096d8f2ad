"""Films and pictures on disk. A file appears under its name only when it is complete.

Pictures that are drawn ahead of their turn, by all processors.
"""

from __future__ import annotations

import io
import logging
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hood.assets.files.atomic import write_atomically
from hood.assets.files.said import install

logger = logging.getLogger(__name__)
_Picture = NDArray[np.uint8]

#: Of H.264, beside preset and quality: the colours of films in high definition, and a file that plays while it is loaded.
ENCODING = (
    "-vf", "scale=out_color_matrix=bt709:out_range=tv", "-pix_fmt", "yuv420p", "-color_range", "tv", "-colorspace", "bt709",
    "-color_primaries", "bt709", "-color_trc", "bt709", "-movflags", "+faststart",
)  # fmt: skip
#: By the table of benchmarks/film.py: folds keep 3 dB more than with veryfast and 20, in the same time.
_QUALITY = ("-preset", "superfast", "-crf", "18")
#: A GIF in place of an MP4 is halved where it has more pixels than this.
_MOST_PIXELS = 400_000
#: Frames that are drawn at once at most; each takes some 30 MB.
_THREADS = 8
_PICTURES_HINT = f"need Pillow: {install('pictures')}"


def drawn(
    draw: Callable[[int], _Picture], frames: Iterable[int], busy: Callable[[], bool] = bool
) -> Iterator[tuple[int, _Picture]]:
    """Frames and their pictures (H, W, 3) uint8, in their order; drawn some frames ahead, by as many threads as this process
    may use processors, up to a bound: no picture depends on their number.

    Args:
        draw: the picture of a frame.
        busy: whether one of the processors is left to others, asked before every frame; never by default.
    """
    threads = min(_THREADS, processors())
    if threads == 1:
        yield from ((index, draw(index)) for index in frames)
        return
    with ThreadPoolExecutor(threads) as pool:
        ahead: deque[tuple[int, Future[_Picture]]] = deque()
        for index in frames:
            ahead.append((index, pool.submit(draw, index)))
            while len(ahead) > (threads - 2 if busy() else threads):
                first, picture = ahead.popleft()
                yield first, picture.result()
        for first, picture in ahead:
            yield first, picture.result()


def processors() -> int:
    """How many of them this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # not every system has it
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


def save_png(path: str | Path, image: _Picture) -> Path:
    """Writes (H, W, 3) uint8, or 4 with straight alpha, as PNG; returns the path."""
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError(f"PNG files {_PICTURES_HINT}") from error
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    packed = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(packed, format="PNG", compress_level=4)  # half the time of 6, for 7% more
    write_atomically(path, packed.getvalue())
    return path


def smaller(image: _Picture, width: int, height: int) -> _Picture:
    """The picture in fewer pixels, each the mean of what it covers; seen through, it is put on white."""
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError(f"contact sheets {_PICTURES_HINT}") from error
    if image.shape[2] == 4:
        share = image[..., 3:] / 255.0
        image = (share * image[..., :3] + (1.0 - share) * 255.0 + 0.5).astype(np.uint8)
    if (width, height) == (image.shape[1], image.shape[0]):
        return np.ascontiguousarray(image)
    return np.asarray(Image.fromarray(np.ascontiguousarray(image)).resize((width, height), Image.Resampling.LANCZOS))


class VideoWriter:
    """Writes frames to `path`: H.264 for `.mp4`, an animated GIF for `.gif`.

    Without imageio-ffmpeg an `.mp4` becomes a `.gif`, half as wide and high where it is large, with a warning; `path`
    holds the name in use. The file gets its name when the `with` block ends without an error; otherwise nothing is left behind.

        with VideoWriter("walk.mp4", fps=30) as film:
            film.append(image)
    """

    def __init__(self, path: str | Path, fps: float = 30.0):
        given = path = Path(path)
        if path.suffix not in (".mp4", ".gif"):
            raise ValueError(f"video {str(path)!r}: suffix must be .mp4 or .gif")
        if fps <= 0:
            raise ValueError(f"video {str(path)!r}: fps must be positive, got {fps}")
        self._ffmpeg: Any = _find_ffmpeg() if path.suffix == ".mp4" else None
        if path.suffix == ".mp4" and self._ffmpeg is None:
            path = path.with_suffix(".gif")
            logger.warning("imageio-ffmpeg is missing (%s): writing %s instead", install("pictures"), path)
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.fps = fps
        self._partial = _partial(path)
        self._instead = path.suffix != given.suffix
        self._shape: tuple[int, ...] | None = None
        self._stream: Any = None
        self._gif_frames: list[io.BytesIO] = []

    def append(self, image: _Picture) -> None:
        """Adds one frame (H, W, 3) uint8; all frames have one size. An odd last row or column is dropped."""
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            given = f"{image.shape} {image.dtype}"
            raise ValueError(f"video {str(self.path)!r}: a frame must be (H, W, 3) uint8, got {given}")
        if self._shape is None:
            self._shape = image.shape
        if image.shape != self._shape:
            raise ValueError(f"video {str(self.path)!r}: frame {image.shape} after frames {self._shape}")
        even = np.ascontiguousarray(image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2])
        if self._ffmpeg is not None:
            self._send(even)
        else:
            self._keep(even)

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            if self._stream is not None:
                self._stream.close()
            elif self._gif_frames and kind is None:
                self._save_gif()
            if kind is None:
                if self._shape is None:
                    raise ValueError(f"video {str(self.path)!r}: no frames were appended")
                os.replace(self._partial, self.path)
        finally:
            self._partial.unlink(missing_ok=True)

    def _send(self, image: _Picture) -> None:
        if self._stream is None:
            height, width = image.shape[:2]
            self._stream = self._ffmpeg.write_frames(
                str(self._partial),
                (width, height),
                fps=self.fps,
                codec="libx264",
                pix_fmt_out="yuv420p",
                macro_block_size=2,
                output_params=[*_QUALITY, *ENCODING],
                ffmpeg_log_level="error",
            )
            self._stream.send(None)
        self._stream.send(image)

    def _keep(self, image: _Picture) -> None:
        try:
            from PIL import Image
        except ImportError as error:
            raise ImportError(f"GIF films {_PICTURES_HINT}") from error
        packed, picture = io.BytesIO(), Image.fromarray(image)
        if self._instead and image.shape[0] * image.shape[1] > _MOST_PIXELS:
            picture = picture.reduce(2)
        picture.save(packed, format="PNG", compress_level=1)
        self._gif_frames.append(packed)

    def _save_gif(self) -> None:
        from PIL import Image

        stride = max(1, len(self._gif_frames) // 8)
        pictures = [Image.open(packed).convert("RGB") for packed in self._gif_frames[::stride]]
        # One palette for the whole film: palettes that change from frame to frame flicker.
        strip = Image.fromarray(np.concatenate([np.asarray(picture) for picture in pictures]))
        palette = strip.quantize(256, dither=Image.Dither.NONE)
        first, *rest = (
            Image.open(packed).convert("RGB").quantize(palette=palette, dither=Image.Dither.NONE) for packed in self._gif_frames
        )
        # GIF counts time in hundredths of a second.
        duration = max(20, round(100.0 / self.fps) * 10)
        first.save(self._partial, save_all=True, append_images=rest, duration=duration, loop=0, format="GIF")


class PngWriter:
    """Writes frames as `00000.png`, `00001.png`, … into the folder `path`, which is there when all of them are.

    As :class:`VideoWriter`; what is transparent stays so.
    """

    def __init__(self, path: str | Path):
        self.path, self._count = Path(path), 0
        self._partial = _partial(self.path)

    def append(self, image: _Picture) -> None:
        """Adds one frame (H, W, 3) or (H, W, 4) uint8."""
        try:
            from PIL import Image
        except ImportError as error:
            raise ImportError(f"PNG files {_PICTURES_HINT}") from error
        Image.fromarray(image).save(self._partial / f"{self._count:05d}.png", compress_level=1)
        self._count += 1

    def __enter__(self) -> PngWriter:
        shutil.rmtree(self._partial, ignore_errors=True)
        self._partial.mkdir(parents=True)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if kind is None:
            shutil.rmtree(self.path, ignore_errors=True)
            os.replace(self._partial, self.path)
        else:
            shutil.rmtree(self._partial, ignore_errors=True)


def video_writer(path: Path, fps: float) -> VideoWriter | PngWriter:
    """The writer of a film: of a folder of PNG files where the path has no suffix."""
    return VideoWriter(path, fps) if path.suffix else PngWriter(path)


def _partial(path: Path) -> Path:
    """Always the same: what a process that was killed left under it is written over by the next."""
    return path.with_name(f".{path.stem}.partial{path.suffix}")


def _find_ffmpeg() -> Any:
    try:
        import imageio_ffmpeg
    except ImportError:
        return None
    return imageio_ffmpeg
