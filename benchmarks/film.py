"""Seconds of a whole film, drawn and encoded; and what encoding leaves of the cloth.

    taskset -c 0 python benchmarks/film.py outputs/dance                   # any folder of hood rollout, or its rollout.h5
    taskset -c 0 python benchmarks/film.py outputs/dance --other ../then   # and by another checkout of this repository
    python benchmarks/film.py outputs/dance --encoders                     # the table that the encoder was chosen by

Every film is made in a process of its own; they take turns, and medians are printed: of the wall clock, and of the processor's
time with that of ffmpeg. The libraries are compiled before. An encoder's figures are of the first 45 frames of the film:
processor's milliseconds a frame, kilobytes a frame, and the peak signal-to-noise ratio [dB] of the cloth's pixels, in every
fifth decoded frame against the one that was drawn, of all colours and of luminance.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

_ROOT = Path(__file__).resolve().parent.parent
#: Makes a film as the checkout on the path does by default; one that has no views makes the film of then.
_FILM = """
import resource, sys, time
from pathlib import Path
import hood.media.film as film
from hood.rollouts.file.reader import read_rollout
data = read_rollout(Path(sys.argv[1]))
views = {} if not hasattr(film, "Shots") else {"width": 1280, "height": 720, "shots": film.Shots()}
film.Film(data, **views).frame(0)
def spent():
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
wall, used = time.perf_counter(), spent()
film.write_video(film.Film(data, **views), Path(sys.argv[2]), range(min(int(sys.argv[3]), len(data.cloth_pos))))
print(time.perf_counter() - wall, spent() - used)
"""
_ENCODERS = [(preset, crf) for preset in ("faster", "veryfast", "superfast", "ultrafast") for crf in (20, 18, 16)]
_FRAMES, _EVERY = 45, 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rollout", type=Path)
    parser.add_argument("--other", type=Path, help="another checkout")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--encoders", action="store_true")
    given = parser.parse_args()
    path = given.rollout / "rollout.h5" if given.rollout.is_dir() else given.rollout
    if given.encoders:
        encoders(path)
        return
    checkouts = [_ROOT] + ([given.other] if given.other else [])
    found: dict[Path, list[tuple[float, float, int]]] = {checkout: [] for checkout in checkouts}
    for _ in range(given.rounds):
        for checkout in checkouts:
            found[checkout].append(_one(checkout, path, given.frames))
    print(f"{'checkout':40s} {'s':>8s} {'s of processor':>16s} {'kB':>8s}")
    for checkout, rows in found.items():
        wall, used, size = (statistics.median(column) for column in zip(*rows, strict=True))
        print(f"{checkout!s:40s} {wall:8.2f} {used:16.2f} {size / 1e3:8.0f}")


def _one(checkout: Path, path: Path, frames: int) -> tuple[float, float, int]:
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / "film.mp4"
        command = [sys.executable, "-P", "-c", _FILM, str(path.resolve()), str(film), str(frames)]
        run = subprocess.run(
            command, env={**os.environ, "PYTHONPATH": str(checkout.resolve())}, capture_output=True, text=True, check=True
        )
        wall, used = map(float, run.stdout.split())
        return wall, used, film.stat().st_size


def encoders(path: Path) -> None:
    """Print the table."""
    import imageio_ffmpeg

    from hood.media.film import Film, Shots
    from hood.media.video import ENCODING
    from hood.rollouts.file.reader import read_rollout

    film = Film(read_rollout(path), 1280, 720, shots=Shots())
    count = min(_FRAMES, len(film.data.cloth_pos))
    frames = [film.frame(index) for index in range(count)]
    film._own_colour = np.tile([1.0, 0.0, 1.0], (len(film._own_colour), 1))
    cloth = []
    for index in range(0, count, _EVERY):
        red, green, blue = np.moveaxis(film.frame(index).astype(int), 2, 0)
        cloth.append((red - green > 60) & (blue - green > 60))
    print(f"{'preset':10s} {'crf':>4s} {'ms':>6s} {'kB':>6s} {'dB':>6s} {'dB of luminance':>16s}")
    for preset, crf in _ENCODERS:
        with tempfile.TemporaryDirectory() as folder:
            file, before = Path(folder) / "film.mp4", resource.getrusage(resource.RUSAGE_CHILDREN)
            options = ["-preset", preset, "-crf", str(crf), *ENCODING]
            stream = imageio_ffmpeg.write_frames(
                str(file), (1280, 720), fps=30, macro_block_size=2, output_params=options, ffmpeg_log_level="error"
            )
            stream.send(None)
            for frame in frames:
                stream.send(frame)
            stream.close()
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            stream = imageio_ffmpeg.read_frames(str(file))
            next(stream)
            off = []
            for index, packed in enumerate(stream):
                if index % _EVERY == 0 and index < count:
                    picture = np.frombuffer(packed, dtype=np.uint8).reshape(720, 1280, 3).astype(np.float64)
                    off.append((picture - frames[index])[cloth[index // _EVERY]])
            error = np.concatenate(off)
            noise, dim = (error**2).mean(), ((error @ [0.2126, 0.7152, 0.0722]) ** 2).mean()
            figures = (10.0 * np.log10(255.0**2 / value) for value in (noise, dim))
            size = file.stat().st_size / 1e3 / count
            print(f"{preset:10s} {crf:4d} {1e3 * used / count:6.1f} {size:6.1f} " + "{:6.1f} {:16.1f}".format(*figures))


if __name__ == "__main__":
    main()
