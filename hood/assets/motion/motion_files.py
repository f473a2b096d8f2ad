"""Many motions: names, files, globs and split files in; sequences out, read when they are needed and kept within a bound.

Of a file that has not been used only the number of frames is known. It is read from the headers of an AMASS archive without
unpacking the poses, 10,000 files in 2 s of processor time; other layouts are read once in full.
"""

from __future__ import annotations

import json
import warnings
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from glob import glob, has_magic
from pathlib import Path
from typing import IO, Any, overload

import numpy as np

from hood.assets.files.library import DATA_FOLDER
from hood.assets.motion.recording import motion_suffixes
from hood.assets.motion.sequence import PoseSequence

#: Parts of a split.
PARTS = ("train", "validation")
_LISTS = (".json", ".txt")


def find_motions(entries: Iterable[str], part: str = "train") -> list[str]:
    """Names and files that ``entries`` stand for, in their order, globs sorted, nothing twice.

    An entry is the name of an embedded motion, a file, a glob (``amass/**/*_poses.npz``), or a list of such entries: a text
    file with one entry a line (``#`` starts a comment), a JSON list, or a JSON split
    ``{"train": […], "validation": […]}`` of which ``part`` is taken. Relative paths in a list start from its folder.

    Raises:
        FileNotFoundError: a list that does not exist.
        ValueError: a glob without a match, a list that cannot be read or lacks the part; names the file.
    """
    found: dict[str, None] = {}
    for entry in map(str, entries):
        found.update(dict.fromkeys(_expand(entry, part)))
    return list(found)


class MotionFiles(Sequence[PoseSequence]):
    """Motions behind names and files, read by ``load`` on first use; the last ones used are kept.

    Args:
        names: what ``load`` takes, as from :func:`find_motions`.
        load: reads one motion, at ``fps``.
        fps: frames per second of the sequences that ``load`` returns.
        min_frames: motions with fewer frames cannot be used.
        skip: leave motions out that cannot be used or read, and count them in ``skipped``; otherwise they are refused.
            A file whose fault shows only when its poses are read is then passed over by whoever draws it.
        kept_frames: frames kept in memory, at 0.6 kB each, those of the motions used last.

    Raises:
        ValueError: a motion that cannot be used; names the file, the reason and the way to skip it. No motion is left.
    """

    def __init__(
        self,
        names: Sequence[str],
        load: Callable[[str], PoseSequence],
        fps: float,
        min_frames: int = 2,
        skip: bool = False,
        kept_frames: int = 100_000,
    ) -> None:
        self._load, self.fps, self.skip, self.kept_frames = load, fps, skip, kept_frames
        self.names: list[str] = []
        self.skipped: list[str] = []  # one sentence each
        lengths = []
        for name in names:
            try:
                length = _num_frames(name, fps) or load(name).num_frames
                if length < min_frames:
                    raise ValueError(f"{name}: {length} frames at {fps:g} fps, at least {min_frames} are needed")
            except (ValueError, OSError) as error:
                if not skip:
                    kind = FileNotFoundError if isinstance(error, FileNotFoundError) else ValueError
                    raise kind(f"{error} (data.unusable=skip leaves such motions out)") from error
                self.skipped.append(str(error))
                continue
            self.names.append(name)
            lengths.append(length)
        if not self.names:
            reason = f": {self.skipped[0]}" if self.skipped else ""
            raise ValueError(f"none of {len(names)} motions can be used{reason}")
        self.lengths = np.array(lengths)
        self._kept: OrderedDict[int, PoseSequence] = OrderedDict()
        self._warned: set[int] = set()

    def __len__(self) -> int:
        return len(self.names)

    @overload
    def __getitem__(self, index: int) -> PoseSequence: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[PoseSequence]: ...
    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        index = range(len(self))[index]
        if index not in self._kept:
            self._kept[index] = self._read(index)
            while len(self._kept) > 1 and sum(s.num_frames for s in self._kept.values()) > self.kept_frames:
                self._kept.popitem(last=False)
        self._kept.move_to_end(index)
        return self._kept[index]

    def usable(self, index: int) -> PoseSequence | None:
        """Motion ``index``; None, and a warning the first time, where it cannot be read and ``skip`` allows for that."""
        try:
            return self[index]
        except (ValueError, OSError) as error:
            if not self.skip:
                raise
            if index not in self._warned:
                warnings.warn(f"skipped motion {error}", stacklevel=2)
                self._warned.add(index)
            return None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_kept": OrderedDict()}  # another process reads what it needs itself

    def _read(self, index: int) -> PoseSequence:
        sequence = self._load(self.names[index])
        if sequence.num_frames != self.lengths[index]:
            raise ValueError(
                f"{self.names[index]}: {sequence.num_frames} frames, {self.lengths[index]} by its header; the file has changed "
                "since training started, or is damaged"
            )
        return sequence


def motion_lengths(motions: Sequence[PoseSequence]) -> np.ndarray:
    """(N,) numbers of frames; files are not read for it."""
    return motions.lengths if isinstance(motions, MotionFiles) else np.array([motion.num_frames for motion in motions])


def _expand(entry: str, part: str, folder: Path | None = None) -> list[str]:
    path = Path(entry).expanduser()
    if path.suffix in _LISTS and folder is None:
        return [name for line in _entries(path, part) for name in _expand(line, part, path.parent)]
    based = path if folder is None else folder / path
    if has_magic(entry):
        files = sorted(file for file in glob(str(based), recursive=True) if Path(file).is_file())
        if not files:
            raise ValueError(f"no file matches {str(based)!r}; ** stands for any folders, e.g. 'amass/**/*_poses.npz'")
        return files
    if based.is_dir():
        raise ValueError(f"{based}: a folder; write which files in it, e.g. '{based}/**/*_poses.npz'")
    # Not found beside the list: an embedded name, or an error that whoever reads it words best.
    return [str(based) if folder is not None and (based.is_file() or path.suffix in motion_suffixes()) else entry]


def _entries(path: Path, part: str) -> list[str]:
    """Entries of a list file."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".txt":
        entries = [line.split("#")[0].strip() for line in text.splitlines()]
        return [entry for entry in entries if entry]
    try:
        content = json.loads(text)
    except ValueError as error:
        raise ValueError(f"{path}: not readable as JSON ({error})") from error
    if isinstance(content, dict):
        if part not in content:
            raise ValueError(f"{path}: has no {part!r} (found {sorted(content)}); a split holds {' and '.join(PARTS)}")
        content = content[part]
    if not isinstance(content, list) or not all(isinstance(entry, str) for entry in content):
        raise ValueError(f"{path}: must hold a list of names, files or globs, or one for each of {' and '.join(PARTS)}")
    return content


# ---- frames by header ------------------------------------------------------------------------------------------------

_POSES = ("poses", "root_orient")
_RATES = ("mocap_framerate", "mocap_frame_rate")


def _num_frames(name: str, fps: float) -> int | None:
    """Frames at ``fps`` of an AMASS archive, by its headers; None where they do not tell."""
    path = DATA_FOLDER / "motions" / f"{name}.npz"
    path = path if path.is_file() else Path(name).expanduser()
    if path.suffix != ".npz":
        return None
    try:
        with zipfile.ZipFile(path) as archive:
            members = set(archive.namelist())
            poses = next((key for key in _POSES if f"{key}.npy" in members), None)
            rate = next((key for key in _RATES if f"{key}.npy" in members), None)
            if poses is None or rate is None:
                return None
            with archive.open(f"{poses}.npy") as file:
                shape = _shape(file)
            with archive.open(f"{rate}.npy") as file:
                value = np.lib.format.read_array(file, allow_pickle=False)
        frames = int(np.floor((shape[0] - 1) * fps / float(value.reshape(-1)[0]) + 1e-9)) + 1
    except (OSError, ValueError, TypeError, IndexError, ArithmeticError, EOFError, zipfile.BadZipFile):
        return None  # reading it in full says better what is wrong
    return frames if frames >= 2 else None


def _shape(file: IO[bytes]) -> tuple[int, ...]:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    return read(file)[0]
