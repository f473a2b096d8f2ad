"""``hood dress``: a data set of many rollouts, by one command that goes on where it stopped.

``dry_run=true``: a few frames of a few rows, and what all of them come to.
"""

from __future__ import annotations

import random
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from omegaconf import DictConfig

from hood.app.batch.engines import LOCAL, TORCHRUN, check_engine, run_engine, tells_user, workers_of
from hood.app.batch.manifest import (
    DOUBTFUL,
    FAILED,
    UNSOUND,
    VERDICTS,
    Line,
    Manifest,
    check_parquet,
    mend_manifest,
    open_rows,
    read_manifest,
    require_same_rows,
    write_parquet,
)
from hood.app.batch.rows import AXES, DataRow, rows_of
from hood.app.batch.work import Call, cause_of, clear, settings_of, silently
from hood.app.common import output_folder, prepare_folder
from hood.app.output.export import check_outputs
from hood.app.output.verdict import FAIL_ON_DOUBTS, FAIL_ON_NOTHING
from hood.app.output.verdict import UNSOUND as UNSOUND_CODE
from hood.app.rollout import roll_out_into
from hood.app.settings.compose import ConfigError, load_config, named_today, require_choice, shown
from hood.app.settings.record import require_same_config, save_run_record
from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.setup import check_config, make_scene, make_stepper
from hood.app.stepping.automatic import AUTO, decided
from hood.assets.files.atomic import occupy
from hood.assets.files.library import unknown
from hood.assets.files.said import say, unheard
from hood.assets.motion.motion_files import frames_by_header
from hood.rollouts.file.reader import read_rollout

#: What rows have unless the command says otherwise: pictures of thousands are of use to nobody.
_USUAL = ("video=none", "sheet=false")
#: Keys of a rollout that the rows say, and what says them here.
_OF_ROWS = {"garment": "garments=[…]", "body": "bodies=[…]", "material": "fabrics=[…]", "sequence": "motions=[…]"}
#: What may differ from the record of an earlier call: what rows have of their own, and what changes no result.
_FREE = (*_OF_ROWS, "output", "resume", "fail_on")
#: Which finished rows are made again.
_RETRY = ("none", "failed", "unsound")
#: Rows that a dry run looks at, frames of each, a few and more, and motions that it reads where headers tell no length.
_PROBES, _PROBE_FRAMES, _READ = 12, (4, 30), 20
#: The sheet of rows: its file, the size of a picture and how many are in a row, and letters of a name.
_THUMBNAILS, _WIDTH, _HEIGHT, _COLUMNS, _LETTERS = "thumbnails.png", 240, 336, 6, 36
#: Lines of a list at the end.
_SHOWN = 10


@dataclass(frozen=True)
class Dressed:
    """What came of a call.

    Args:
        lines: of all rows that are done, by name, also in earlier calls.
        total: rows that there are to be.
        interrupted: by the user; what is done is kept.
        code: the exit code.
    """

    lines: Mapping[str, Line]
    total: int
    interrupted: bool
    code: int


def dress_rows(overrides: Sequence[str]) -> Dressed:
    """Run what the words of ``hood dress`` ask for; the rest of its words are those of a rollout.

    Raises:
        ConfigError, ValueError, OSError: words, files or a folder that cannot be used; an engine that cannot work.
        hood.assets.files.atomic.OccupiedError: another call works in the output folder.
    """
    config, given, words = _split(overrides)
    _check(config)
    common, why = _common(words, int(config.seed))
    rows, start = rows_of(config, given)
    record = common.with_values(root=start or None, seed=int(config.seed))
    folder = output_folder(config)
    known = _earlier(folder, record, rows)
    for sentence in why if tells_user() else ():
        say(sentence)
    if bool(config.dry_run):
        _tell_plan(config, words, rows, sum(row.name in known for row in rows))
        return Dressed(known, len(rows), False, 0)
    with ExitStack() as stack:
        if tells_user():
            stack.enter_context(occupy(prepare_folder(folder)))
            clear(folder)
            mended = mend_manifest(folder, rows)
            if mended:
                say(f"{mended} rows were whole and had no line in manifest.jsonl; they have one now")
            if not (folder / "config.yaml").exists():
                save_run_record(folder, record, int(config.seed))
        else:
            prepare_folder(folder)
        return _work(config, words, rows, folder, str(common.fail_on))


def _work(config: DictConfig, words: Sequence[str], rows: Sequence[DataRow], folder: Path, fail_on: str) -> Dressed:
    left, said = open_rows(folder, rows, read_manifest(folder), str(config.retry))
    for sentence in said if tells_user() else ():
        say(sentence)
    call = Call(folder, tuple(words), int(config.attempts), Manifest(folder).size())
    progress, interrupted = _Progress(folder, call.since, len(rows), len(left)), False
    if tells_user() and len(left) < len(rows):
        say(f"{len(rows) - len(left)} of {len(rows)} rows were done before")
    try:
        if left:
            run_engine(config, call, left, progress.follow if tells_user() else lambda: None)
    except KeyboardInterrupt:
        interrupted = True
    names = {row.name for row in rows}
    lines = {name: line for name, line in read_manifest(folder).items() if name in names}
    if not tells_user():
        return Dressed(lines, len(rows), interrupted, 130 if interrupted else 0)
    clear(folder)
    if int(config.thumbnails) and not interrupted and (left or not (folder / _THUMBNAILS).exists()):
        _draw_rows(config, lines, folder)
    if bool(config.parquet):
        write_parquet(folder)
    code = 130 if interrupted else _conclude(config, lines, len(rows), folder, fail_on)
    return Dressed(lines, len(rows), interrupted, code)


def _split(overrides: Sequence[str]) -> tuple[DictConfig, list[str], list[str]]:
    """The command's own config, its keys that are given, and the words of all rollouts."""
    own, theirs = [str(key) for key in load_config("dress")], [str(key) for key in load_config("rollout")]
    mine, words = list[str](), list[str]()
    for word in overrides:
        key = word.partition("=")[0].lstrip("+~")
        if key in _OF_ROWS and "=" in word:
            raise ConfigError(f"{word}: the rows of hood dress come from {_OF_ROWS[key]}; write that")
        if key == "resume":
            raise ConfigError(f"{word}: hood dress goes on by itself where the same command stopped; leave it out")
        if "=" in word and key.split(".")[0] not in (*own, *theirs):
            raise ConfigError(unknown("key", key, [*own, *theirs]))
        if key in AXES and "=" in word and not word.partition("=")[2].startswith("["):
            word = f"{key}=[{word.partition('=')[2]}]"
        (mine if key in own or "=" not in word or word.startswith("-") else words).append(word)
    return load_config("dress", mine), [word.partition("=")[0] for word in mine], list(named_today([*_USUAL, *words]))


def _check(config: DictConfig) -> None:
    """Raise ConfigError where a key of the command cannot be meant."""
    require_choice(config, "retry", _RETRY)
    if not 0.0 <= float(config.fail_fraction) <= 1.0:
        raise ConfigError(f"fail_fraction={shown(config.fail_fraction)}: give a share of the rows, 0 to 1")
    for key, least in (("attempts", 1), ("seed", 0), ("thumbnails", 0)):
        if int(config[key]) < least:
            raise ConfigError(f"{key}={config[key]}: must be at least {least}")
    output_folder(config)
    check_parquet(bool(config.parquet))
    check_engine(config)


def _common(words: list[str], seed: int) -> tuple[RolloutSettings, list[str]]:
    """The settings that all rows have, and why these; the stepper is named among ``words`` afterwards."""
    config = RolloutSettings.from_words([*words, f"seed={seed}"])
    check_config(config)
    check_outputs(config)
    if str(config.plan) not in ("auto", "full"):
        raise ConfigError(f"plan={shown(config.plan)}: a plan is of one scene; give auto or full")
    settled, why = decided(config)
    if str(settled.stepper) == AUTO:
        raise ConfigError("stepper=auto: measures every scene anew; name a stepper for all rows, stepper=newton or network")
    if settled is not config:
        words.append(f"stepper={settled.stepper}")
    return settled, why


def _earlier(folder: Path, record: RolloutSettings, rows: Sequence[DataRow]) -> dict[str, Line]:
    """The lines of earlier calls, whose settings are the same.

    Raises:
        ConfigError: they are not, or the folder is that of something else; names the key.
    """
    known = read_manifest(folder)
    if not known and ((folder / "rollout.h5").exists() or (folder / "summary.json").exists()):
        raise ConfigError(f"output={folder}: holds rollouts of hood rollout; choose another output")
    keys = sorted(record, key=lambda key: isinstance(record[key], DictConfig))  # groups take values from keys
    require_same_config({key: record[key] for key in keys}, folder, _FREE)
    require_same_rows(folder, rows, known)
    return known


# ---- what is told ----------------------------------------------------------------------------------------------------


class _Progress:
    """Tells every row that is done, with the rate of this call and the time that is left."""

    def __init__(self, folder: Path, since: int, total: int, left: int) -> None:
        self._manifest, self._total, self._left = Manifest(folder, since), total, left
        self._began, self._done, self._frames = time.monotonic(), 0, 0

    def follow(self) -> None:
        for line in self._manifest.new():
            self._done += 1
            self._frames += int(line.get("frames", 0))
            say(f"[{self._total - self._left + self._done}/{self._total}] {describe_line(line)}; {self._pace()}", passing=True)

    def _pace(self) -> str:
        spent = time.monotonic() - self._began
        ahead = spent / self._done * max(self._left - self._done, 0)
        return f"{self._frames / spent:.1f} frames/s, {_duration(ahead)} left"


def describe_line(line: Mapping[str, object]) -> str:
    """A row in a few words."""
    if line["verdict"] == FAILED:
        return f"{line['row']}: failed: {line.get('error', '')}"
    return f"{line['row']}: {line['verdict']}, {line['frames']} frames, {line['seconds']:.1f} s"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"


def _conclude(config: DictConfig, lines: Mapping[str, Line], total: int, folder: Path, fail_on: str) -> int:
    """Say what all calls have come to; the exit code."""
    counts = Counter(line["verdict"] for line in lines.values())
    parts = [f"{counts[verdict]} {verdict}" for verdict in VERDICTS if counts[verdict]]
    if len(lines) < total:
        parts.append(f"{total - len(lines)} not done, the same command goes on")
    frames, size = (sum(int(line.get(key, 0)) for line in lines.values()) for key in ("frames", "bytes"))
    hours = sum(float(line.get("cpu_seconds", 0.0)) for line in lines.values()) / 3600
    say(f"{total} rows in {folder}: {', '.join(parts)}; {frames:,} frames, {size / 1e9:.3g} GB, {hours:.3g} hours of a core")
    _tell_causes(lines.values())
    limit, bad, word = float(config.fail_fraction), counts[UNSOUND], "are unsound"
    if fail_on == FAIL_ON_DOUBTS:
        bad, word = bad + counts[DOUBTFUL], "are unsound or doubtful"
    for count, what, code in ((counts[FAILED], "failed", 2), (bad * (fail_on != FAIL_ON_NOTHING), word, UNSOUND_CODE)):
        if count > limit * total:
            say(f"hood: {count} of {total} rows {what}, more than fail_fraction={limit:g} allows; exit code {code}", error=True)
            return code
    return 2 if len(lines) < total else 0


def _tell_causes(lines: Iterable[Line]) -> None:
    """Failed and unsound rows, by cause."""
    groups = defaultdict[str, list[Line]](list)
    for line in lines:
        if line["verdict"] == FAILED:
            groups[f"failed: {line['cause']}"].append(line)
        elif line["verdict"] == UNSOUND:
            groups[f"unsound: {_without_numbers(line)}"].append(line)
    ranked = sorted(groups.items(), key=lambda pair: -len(pair[1]))
    for cause, found in ranked[:_SHOWN]:
        first = found[0]
        example = first.get("error") or (first.get("reasons") or [""])[0]
        say(f"{len(found)} × {cause if len(found) > 1 else cause.partition(':')[0] + ': ' + example} (as {first['row']})")
    if len(ranked) > _SHOWN:
        say(f"and {len(ranked) - _SHOWN} further causes, in manifest.jsonl")


def _without_numbers(line: Line) -> str:
    reasons = line.get("reasons") or ["the guard ended it"]
    return cause_of(reasons[0])


def _draw_rows(config: DictConfig, lines: Mapping[str, Line], folder: Path) -> None:
    """``thumbnails.png``: rows that are drawn by chance, then the worst ones, each in its worst frame."""
    try:
        from hood.media.film import Film
        from hood.media.renderer.render import contact_sheet
        from hood.media.video import save_png
    except ImportError as error:
        say(f"no {_THUMBNAILS}: {error}", error=True)
        return
    made = sorted(name for name, line in lines.items() if line["frames"] and line["verdict"] != FAILED)
    most = min(int(config.thumbnails), len(made))
    worst = sorted(made, key=lambda name: _badness(lines[name]), reverse=True)[:most]
    chance = sorted(random.Random(int(config.seed)).sample(made, most)) if len(made) > most else []
    pictures, labels = [], []
    for what, name in (*(("by chance", name) for name in chance), *(("worst", name) for name in worst)):
        line = lines[name]
        try:
            data = read_rollout(folder / name / "rollout.h5")
            frame = min(line.get("worst", {}).get("frame", 0), len(data.cloth_pos) - 1)
            pictures.append(Film(data, _WIDTH, _HEIGHT).picture(frame))
        except (OSError, ValueError, ImportError) as error:
            say(f"no picture of {name}: {error}", error=True)
            continue
        short = name if len(name) <= _LETTERS else f"…{name[1 - _LETTERS :]}"
        labels.append(f"{short}\n{what}, {line['verdict']}, frame {frame}")
    if pictures:
        save_png(folder / _THUMBNAILS, contact_sheet(pictures, min(_COLUMNS, len(pictures)), labels))
        say(f"{len(chance)} rows by chance and the {len(worst)} worst: {folder / _THUMBNAILS}")


def _badness(line: Line) -> tuple[int, float]:
    """Orders rows: unsound ones are worse than doubtful ones, then more strain is worse."""
    return (line["verdict"] == DOUBTFUL) + 2 * (line["verdict"] == UNSOUND), float(line.get("worst", {}).get("value") or 0.0)


# ---- dry run ---------------------------------------------------------------------------------------------------------


@dataclass
class _Cost:
    """What a row costs: seconds and bytes of any row, and of a frame."""

    row_seconds: float
    frame_seconds: float
    row_bytes: float
    frame_bytes: float


def _tell_plan(config: DictConfig, words: Sequence[str], rows: Sequence[DataRow], done: int) -> None:
    """Rows, frames, hours and bytes of the whole data set.

    Raises:
        ValueError: none of the rows that were looked at can be used.
    """
    costs, failures = dict[str, list[_Cost]](), []
    chosen = _probed(rows)
    with tempfile.TemporaryDirectory() as place:
        for count, row in enumerate([chosen[0], *chosen]):  # the first time much is read that is kept
            try:
                with unheard():
                    cost = _probe(words, row, Path(place) / str(count))
                costs.setdefault(_scene_of(row), [])
                costs[_scene_of(row)] += [cost] if count else []
            except (ValueError, OSError) as error:
                failures += [f"{row.name}: {' '.join(str(error).split())}"] if count else []
    measured = [cost for group in costs.values() for cost in group]
    if not measured:
        raise ValueError(f"none of the {len(chosen)} rows that were tried can be used: {failures[0]}")
    frames = _frames_of(words, rows)
    spent = [_cost_of(row, costs, measured) for row in rows]
    seconds = sum(cost.row_seconds + cost.frame_seconds * count for cost, count in zip(spent, frames, strict=True))
    size = sum(cost.row_bytes + cost.frame_bytes * count for cost, count in zip(spent, frames, strict=True))
    workers = workers_of(config)
    say(f"rows: {len(rows):,}" + (f", {done:,} of them done" if done else ""))
    say(f"frames: {sum(frames):,.0f}, {sum(frames) / len(rows):.0f} a row")
    side = f", {seconds / 3600 / workers:.3g} with {workers} processes" if str(config.engine) in (LOCAL, TORCHRUN) else ""
    say(f"time: {seconds / 3600:.3g} hours of a core{side}")
    say(f"space: {size / 1e9:.3g} GB, {size / max(sum(frames), 1) / 1e3:.0f} kB a frame")
    mean = [np.mean([getattr(cost, name) for cost in measured]) for name in ("row_seconds", "frame_seconds")]
    say(f"measured in {len(measured)} rows: {mean[0]:.1f} s a row and {1e3 * mean[1]:.0f} ms a frame")
    for failure in failures:
        say(f"hood: of the {len(chosen)} rows that were tried one failed: {failure}", error=True)


def _probed(rows: Sequence[DataRow]) -> list[DataRow]:
    """Rows by chance, as many of every scene, or of scenes that are spread over all where there are too many: motions beside
    each other are alike."""
    scenes = defaultdict[str, list[DataRow]](list)
    for row in rows:
        scenes[_scene_of(row)].append(row)
    groups = list(scenes.values())
    if len(groups) > _PROBES:
        groups = [groups[place * len(groups) // _PROBES] for place in range(_PROBES)]
    most, chance = -(-_PROBES // len(groups)), random.Random(0)
    return [row for group in groups for row in chance.sample(group, min(most, len(group)))][:_PROBES]


def _scene_of(row: DataRow) -> str:
    return row.keys.get("garment", "")


def _probe(words: Sequence[str], row: DataRow, folder: Path) -> _Cost:
    """Simulate a few frames of a row, and more; what these took longer is the frames'."""
    spent, sizes, counts = [], [], []
    for most in _PROBE_FRAMES:
        config = settings_of(words, row)
        config = config.with_values(num_frames=min(int(config.num_frames), most), output=str(folder))
        check_config(config)
        began, here = time.process_time(), folder / str(most)
        stepper, weights = make_stepper(config)
        counts.append(roll_out_into(config, stepper, weights, silently, here)["num_frames"])
        spent.append(time.process_time() - began)
        sizes.append(sum(file.stat().st_size for file in here.rglob("*") if file.is_file()))
    more = counts[1] - counts[0]
    frame = [max(ends[1] - ends[0], 0.0) / more if more else ends[1] / counts[1] for ends in (spent, sizes)]
    return _Cost(max(spent[1] - counts[1] * frame[0], 0.0), frame[0], max(sizes[1] - counts[1] * frame[1], 0.0), frame[1])


def _cost_of(row: DataRow, costs: Mapping[str, list[_Cost]], measured: Sequence[_Cost]) -> _Cost:
    found = costs.get(_scene_of(row)) or measured
    names = ("row_seconds", "frame_seconds", "row_bytes", "frame_bytes")
    return _Cost(*(float(np.mean([getattr(cost, name) for cost in found])) for name in names))


def _frames_of(words: Sequence[str], rows: Sequence[DataRow]) -> list[float]:
    """Frames of every row, by the headers of its motion; where these do not tell, as many as others have on average."""
    counted = [_count(words, row) for row in rows]
    missing = [row for row, count in zip(rows, counted, strict=True) if count is None]
    read = []
    for row in missing[:: max(1, len(missing) // _READ)][:_READ]:
        config = settings_of(words, row)
        try:
            with unheard():
                read.append(min(int(config.num_frames), make_scene(config).num_frames))
        except (ValueError, OSError):  # it will fail
            continue
    usual = float(np.mean(read)) if read else 0.0
    return [usual if count is None else count for count in counted]


def _count(words: Sequence[str], row: DataRow) -> float | None:
    """Frames of a row by the header of its motion; None where it does not tell."""
    config = settings_of(words, row)
    known = [config.start, config.stop, config.blend_in]
    if any(value is not None and not isinstance(value, (int, float)) for value in known):
        return None
    length = frames_by_header(str(config.sequence), config.fps, config.file_fps)
    if length is None:
        return None
    last = length - 1 if config.stop is None else min(length - 1, float(config.stop) * config.fps)
    played = max(last - float(config.start or 0.0) * config.fps, 0.0) + 1
    return min(float(config.num_frames), played * int(config.loop) + float(config.blend_in) * config.fps)
