"""Many motions: names, files, globs and split files in; sequences out, read when they are needed and kept within a bound.

Of a file that has not been used only the number of frames is known. It is read from the headers of an AMASS archive without
unpacking the poses, 10,000 files in 2 s of processor time; other layouts are read once in full.

Lists of motion files from folders, globs and split lists.
"""

from __future__ import annotations

import csv
import io
import json
import warnings
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from glob import glob, has_magic
from pathlib import Path
from typing import IO, Any, overload

import numpy as np

from hood.assets.files.library import DATA_FOLDER, locate, names, nearest
from hood.assets.files.text import read_text, squeezed
from hood.assets.motion.layouts.content import ARRAYS, TENSORS, WHOLE
from hood.assets.motion.layouts.read import FRAME_IDS
from hood.assets.motion.recording import motion_suffixes
from hood.assets.motion.sequence import PoseSequence

#: Parts of a split.
_PARTS = ("train", "validation")
#: Suffixes of files that name motions.
LISTS = (".json", ".txt", ".csv")


def file_named(name: str) -> Path:
    """The file of an embedded motion, or the one that ``name`` is the path of."""
    return locate("motions", name)


def is_embedded(name: str) -> bool:
    """Whether a motion of this name comes with the package."""
    return name in names("motions")


def find_motions(entries: Iterable[str], part: str = "train", check: bool = True) -> list[str]:
    """Names and files that ``entries`` stand for, in their order, globs sorted, nothing twice.

    An entry is the name of an embedded motion, a file, a folder with its motions as in :func:`motions_in`, a glob
    (``amass/**/*_poses.npz``), or a list of such entries: a text file with one entry a line (``#`` starts a comment), a JSON
    list, a JSON split ``{"train": […], "validation": […]}`` of which ``part`` is taken, or a ``.csv`` table with a column
    ``id`` (or file, path, sequence, name; else its first) of files with or without suffix. Relative paths in a list start from
    its folder.

    Args:
        check: refuse a list with a name that stands for nothing; False where that is left out later.

    Raises:
        FileNotFoundError: a list that does not exist; an entry of a list that is neither a file nor an embedded name: names the
            list, the line (or the index) and the nearest name.
        ValueError: a glob without a match, a folder without motions, a list that cannot be read or lacks the part; names it.
    """
    found: dict[str, None] = {}
    for entry in map(str, entries):
        found.update(dict.fromkeys(_expand(entry, part, check)))
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
        file_fps: frame rate [1/s] at which ``load`` takes the files, whatever they say; None: what each says.

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
        file_fps: float | None = None,
    ) -> None:
        self._load, self.fps, self.skip, self.kept_frames = load, fps, skip, kept_frames
        self.names: list[str] = []
        self.skipped: list[str] = []  # one sentence each
        lengths = []
        for name in names:
            try:
                length = frames_by_header(name, fps, file_fps) or load(name).num_frames
                if length < min_frames:
                    needed = f"at least {min_frames} are needed: trainer.horizon.maximum + 3"
                    raise ValueError(f"{name}: {length} frames at {fps:g} fps, {needed}")
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


def _expand(entry: str, part: str, check: bool) -> list[str]:
    path = Path(entry).expanduser()
    if path.suffix.lower() == ".csv":
        return _in_table(path, check)
    if path.suffix not in LISTS:
        return _matches(path) if has_magic(entry) else _files_of(path, entry)
    found: list[str] = []
    for place, text in _entries(path, part):
        try:
            found += _listed(text, path.parent, check)
        except (ValueError, OSError) as error:
            kind = FileNotFoundError if isinstance(error, FileNotFoundError) else ValueError
            raise kind(f"{path}, {place}: {error}") from error
    return found


def _listed(entry: str, folder: Path, check: bool) -> list[str]:
    """What an entry of a list in ``folder`` stands for; with ``check`` all of it is there."""
    path = Path(entry).expanduser()
    based = folder / path
    if has_magic(entry):
        return _matches(based)
    if based.is_dir():
        return _files_of(based, entry)
    is_path = path.suffix in motion_suffixes()
    if based.is_file() or (is_path and not check):
        return [str(based)]
    if is_path:
        beside = based.parent.iterdir() if based.parent.is_dir() else ()
        near = nearest(based.name, [*(file.name for file in beside if file.suffix == path.suffix), *names("motions")])
        raise FileNotFoundError(f"{based}: no such file; " + (f"did you mean {near!r}?" if near else "check the path"))
    if check:
        locate("motions", entry)
    return [entry]


def _matches(path: Path) -> list[str]:
    files = sorted(file for file in glob(str(path), recursive=True) if Path(file).is_file())
    if not files:
        raise ValueError(f"no file matches {str(path)!r}; ** stands for any folders, e.g. 'amass/**/*_poses.npz'")
    return files


def _files_of(path: Path, entry: str) -> list[str]:
    """The motions of a folder; itself where it is none."""
    return [str(file) for file in motions_in(path)] if path.is_dir() else [entry]


def _entries(path: Path, part: str) -> list[tuple[str, str]]:
    """Entries of a list file, each behind its place there."""
    text = read_text(path)
    if path.suffix == ".txt":
        lines = [line.split("#")[0].strip() for line in text.splitlines()]
        return [(f"line {number}", line) for number, line in enumerate(lines, start=1) if line]
    try:
        content = json.loads(text)
    except ValueError as error:
        raise ValueError(f"{path}: not readable as JSON ({error})") from error
    if isinstance(content, dict):
        if part not in content:
            raise ValueError(f"{path}: has no {part!r} (found {sorted(content)}); a split holds {' and '.join(_PARTS)}")
        content, name = content[part], part
    else:
        name = "list"
    if not isinstance(content, list) or not all(isinstance(entry, str) for entry in content):
        raise ValueError(f"{path}: must hold a list of names, files or globs, or one for each of {' and '.join(_PARTS)}")
    return [(f"{name}[{index}]", entry) for index, entry in enumerate(content)]


# ---- frames by header ------------------------------------------------------------------------------------------------

_POSES = ("poses", "root_orient")
_RATES = ("mocap_framerate", "mocap_frame_rate")
_WIDTHS = (3, *(3 * count for count in WHOLE))


def frames_by_header(name: str, fps: float, file_fps: float | None) -> int | None:
    """Frames at ``fps`` of an AMASS archive, by its headers and ``file_fps``; None where they do not tell."""
    path = DATA_FOLDER / "motions" / f"{name}.npz"
    path = path if path.is_file() else Path(name).expanduser()
    if path.suffix.lower() != ".npz":
        return None
    try:
        with zipfile.ZipFile(path) as archive:
            members = set(archive.namelist())
            poses = next((key for key in _POSES if f"{key}.npy" in members), None)
            rate = next((key for key in _RATES if f"{key}.npy" in members), None)
            if poses is None or (rate is None and file_fps is None):
                return None
            if {squeezed(name.removesuffix(".npy")) for name in members} & set(FRAME_IDS):
                return None
            with archive.open(f"{poses}.npy") as file:
                shape = _shape(file)
            # A pose alone, and tables of several people, have other axes than frames and numbers.
            if not (len(shape) == 2 and shape[1] in _WIDTHS) and not (len(shape) == 3 and shape[1] in WHOLE and shape[2] == 3):
                return None
            if file_fps is None:
                with archive.open(f"{rate}.npy") as file:
                    file_fps = float(np.lib.format.read_array(file, allow_pickle=False).reshape(-1)[0])
        frames = int(np.floor((shape[0] - 1) * fps / file_fps + 1e-9)) + 1
    except (OSError, ValueError, TypeError, IndexError, ArithmeticError, EOFError, zipfile.BadZipFile):
        return None  # reading it in full says better what is wrong
    return frames if frames >= 2 else None


def _shape(file: IO[bytes]) -> tuple[int, ...]:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    return read(file)[0]


#: What lies beside the motions in AMASS folders: subjects' shapes, stages of the fit.
_BESIDES = ("shape", "neutral_stagei", "female_stagei", "male_stagei")
_OFTEN_OTHERS = (*ARRAYS, *TENSORS)
#: Columns of a table that may name the motion.
_NAME_COLUMNS = ("id", "file", "path", "sequence", "name")


def motions_in(folder: Path) -> list[Path]:
    """Motion files in a folder and below, sorted: archives, pickles and what plugins read, without the shapes and stages of the
    fit that AMASS keeps beside them; where there are none, arrays and files of torch.

    Raises:
        ValueError: there are none.
    """
    suffixes = motion_suffixes()
    files = (path for path in folder.rglob("*") if path.suffix.lower() in suffixes and path.is_file())
    every = sorted(path for path in files if path.stem not in _BESIDES and not path.name.startswith("."))
    # Arrays and files of torch are motions in few folders, and lie beside them in many: statistics, weights.
    found = [path for path in every if path.suffix.lower() not in _OFTEN_OTHERS] or every
    if not found:
        raise ValueError(f"{folder}: no motions ({', '.join(suffixes)}) in it or below; give a folder that holds such files")
    return found


def _in_table(path: Path, check: bool) -> list[str]:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        rows = list(csv.DictReader(io.StringIO(read_text(path), newline="")))
    except csv.Error as error:
        raise ValueError(f"{path}: not readable as a table of comma-separated values ({error})") from error
    if not rows:
        raise ValueError(f"{path}: an empty table; give one row per motion below a row of column names")
    column = next((name for name in _NAME_COLUMNS if name in rows[0]), next(iter(rows[0])))
    found = []
    for row, entry in enumerate(rows, start=2):
        name = str(entry[column] or "")
        if not name:
            raise ValueError(f"{path}: row {row} names no motion in {column!r}")
        try:
            found += _listed(_with_suffix(path.parent, name), path.parent, check)
        except (ValueError, OSError) as error:
            kind = FileNotFoundError if isinstance(error, FileNotFoundError) else ValueError
            raise kind(f"{path}, row {row}: {error}") from error
    return found


def _with_suffix(folder: Path, name: str) -> str:
    """The name of a file in a folder, given with or without its suffix."""
    return next((name + suffix for suffix in ("", *motion_suffixes()) if (folder / (name + suffix)).is_file()), name)
