"""``hood train -m``: a training for every combination of values, which Hydra's sweeper makes and Hydra's launcher runs.

Runs go to ``OUTPUT/KEY=VALUE,…``. The same command again goes on with what is not finished; what ends one run ends no other.
"""

from __future__ import annotations

import hashlib
import logging
import math
import os
import re
import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra import initialize_config_dir
from hydra._internal.hydra import Hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from hood.app.common import GivenUpError, output_folder, prepare_folder
from hood.app.notices import heard
from hood.app.settings.compose import CONFIG_FOLDER, SWEEP_FLAGS, ConfigError, load_config, one_line, options, read_word
from hood.app.settings.overrides import parse, quoted, search_path
from hood.app.train import Tick, is_finished, iterations_of, last_record, tell_iterations, train
from hood.assets.files.atomic import is_occupied, occupy, write_atomically
from hood.assets.files.library import unknown
from hood.assets.files.said import install, listening, say, unheard
from hood.plugins import config_folders
from hood.training import distributed
from hood.training.checkpoint import previous, reached

#: Runs of a sweep go there where no output is given.
_FOLDER = "runs/sweep"
#: In the folder of a run that could not be begun or finished: why.
REASON = "error.txt"
#: Launchers that are packages of their own, by the extra that installs them.
_EXTRAS = {"joblib": "joblib", "submitit_local": "slurm", "submitit_slurm": "slurm", "ray": "ray", "ray_aws": "ray"}
#: What may stand in the name of a run's folder, and how long it may be.
_FOREIGN, _LONGEST = re.compile(r"[^\w.,=+@\[\]{}()|:-]"), 160
#: The process that sweeps, which goes on without the one that started it (nohup); a launcher's own processes do not.
_SWEEPING: set[int] = set()
_STARTED_BY = os.getppid()


@dataclass(frozen=True)
class Swept:
    """What came of a sweep.

    Args:
        runs: folders of its runs.
        failed: why those that failed did, by folder.
        interrupted: by the user; checkpoints are kept.
    """

    runs: list[Path]
    failed: dict[Path, str]
    interrupted: bool


def is_sweep(words: Sequence[str]) -> bool:
    """Whether words of ``hood train`` ask for a sweep."""
    return any(word in SWEEP_FLAGS for word in words)


def hydra_of(command: str, words: Sequence[str], info: str | None = None) -> DictConfig:
    """What Hydra composes for the words of a command, its own configuration under ``hydra``; with ``info``, its report of that
    name is printed.

    Raises:
        ConfigError: it cannot.
    """
    hydra, words = _hydra(), [search_path(config_folders()), *words]
    with _own_logging(), _in_one_line():
        if info is not None:
            hydra.show_info(info, command, words)
        return hydra.compose_config(command, words, RunMode.RUN)


def _hydra() -> Hydra:
    """Hydra with our configs, for what it does beyond composing."""
    with initialize_config_dir(str(CONFIG_FOLDER), job_name="train", version_base="1.3"):
        hydra = GlobalHydra.instance().hydra
    assert hydra is not None
    return hydra


@contextmanager
def _in_one_line() -> Iterator[None]:
    """What Hydra cannot do, as a ConfigError."""
    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(f"configuration: {one_line(error)}") from error


def run_sweep(words: Sequence[str]) -> Swept:
    """Run the trainings that the words of ``hood train -m`` ask for; those that are finished already are left alone.

    Raises:
        ConfigError: words that no run could use, or a launcher that is not installed; nothing has been begun.
        OccupiedError: another sweep writes there.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        if not distributed.is_first():
            raise GivenUpError
        raise ConfigError("-m: torchrun shares one training; leave it out, hydra/launcher=joblib runs several at a time")
    hydras = [word for word in words if word.lstrip("+~").startswith(("hydra.", "hydra/"))]
    fixed, swept, folder = _divided([word for word in words if word not in (*SWEEP_FLAGS, *hydras)])
    if not swept and not any(word.startswith("hydra/sweeper=") or "sweeper.params" in word for word in hydras):
        raise ConfigError("-m: no key has several values; write some, such as seed=0,1,2, or leave -m out")
    hydra = _hydra()
    _require_launcher(hydra, hydras)
    constant = ",".join(quoted(parse(word).get_key_element()) for word in fixed)
    own = [
        search_path(config_folders()),
        "hydra.job.name=train",
        f"hydra.sweep.dir={quoted(str(folder))}",
        "hydra.sweep.subdir='${hood_run:${hydra:job.override_dirname}}'",
        f"hydra.job.config.override_dirname.exclude_keys=[{constant}]",
    ]
    words = [*own, *hydras, *fixed, *swept]
    with _in_one_line():
        hydra.compose_config("train", words, RunMode.MULTIRUN)  # before a folder is made
    with occupy(prepare_folder(folder)), _own_logging():
        return _launched(hydra, words, folder)


def _launched(hydra: Hydra, words: list[str], folder: Path) -> Swept:
    interrupted, reason, jobs = False, "", None
    _SWEEPING.add(os.getpid())
    try:
        with _in_one_line():
            jobs = hydra.multirun("train", one_run, words)
    except KeyboardInterrupt:
        interrupted = True
    except ConfigError:
        raise
    except Exception as error:  # of a launcher, as where the system killed a process of it
        if os.environ.get("HOOD_TRACEBACK"):
            raise
        reason = f"the launcher gave up ({one_line(error)}); the same command again goes on"
    finally:
        _SWEEPING.discard(os.getpid())
    if isinstance(jobs, list):
        runs = [Path(job.hydra_cfg.hydra.runtime.output_dir) for batch in jobs for job in batch]
    else:  # another sweeper's result, or none
        runs = sorted(path.parent for path in folder.rglob(".hydra"))
    failed = {run: (run / REASON).read_text(encoding="utf-8").strip() for run in runs if (run / REASON).exists()}
    return Swept(runs, failed | ({folder: reason} if reason else {}), interrupted)


def state_of(run: Path, record: Mapping[str, Any]) -> tuple[int, int | None, str]:
    """How many iterations the training in a folder has done, how many it is to do by the ``record`` of its settings, and
    whether it is finished, running, failed (by :data:`REASON`) or stopped."""
    iteration, written = reached(run)
    trainer = record.get("trainer")
    total = iterations_of(trainer) if isinstance(trainer, Mapping) and "iterations" in trainer else None
    if written and total is not None and iteration >= total:
        return iteration, total, "finished"
    return iteration, total, "running" if is_occupied(run) else "failed" if (run / REASON).exists() else "stopped"


def one_run(_: DictConfig) -> float:
    """A run of a sweep, as Hydra's launchers call it: here or in a process of theirs.

    Returns:
        the relative gradient at its end, for sweepers that look for the least; NaN where it failed, which
        :data:`REASON` in its folder tells.
    """
    hydra = HydraConfig.get()
    folder = Path(hydra.runtime.output_dir)
    words = [*OmegaConf.to_container(hydra.overrides.task), f"output={quoted(str(folder))}"]  # type: ignore[misc]
    log = logging.getLogger(folder.name)

    def tell(sentence: str, error: bool, passing: bool) -> None:
        log.log(logging.WARNING if error and not passing else logging.INFO, sentence.removeprefix("hood: "))

    if _is_orphan():
        os._exit(130)
    (folder / REASON).unlink(missing_ok=True)
    with unheard(), listening(tell), heard():
        try:
            interrupted = _trained(words, folder)
        except Exception as error:
            write_atomically(folder / REASON, f"{one_line(error)}\n".encode())
            log.error(one_line(error), exc_info=not isinstance(error, (ValueError, OSError, ImportError)))
            return math.nan
    if _is_orphan():
        os._exit(130)  # it would begin the next one
    if interrupted:
        raise KeyboardInterrupt
    return float(last_record(folder).get("relative_gradient", math.nan))


def _trained(words: list[str], folder: Path) -> bool:
    """Begin the run, go on with it, or leave it where it is finished; whether it was interrupted.

    Raises:
        ConfigError: the run in the folder has other settings.
    """
    if is_finished(load_config("train", words), folder):
        say("finished before")
        return False
    checkpoint = folder / "checkpoint.pt"
    begun = checkpoint.exists() or previous(checkpoint).exists()
    return train([*words, f"resume={str(begun).lower()}"], _ending_with_the_sweep).interrupted


@contextmanager
def _ending_with_the_sweep(total: int, done: int) -> Iterator[Tick]:
    """A :data:`hood.app.train.TrainingBar`. A launcher's process whose sweep was killed ends as by SIGTERM, with a checkpoint:
    it would hold the folder against the same command."""
    with tell_iterations(total, done) as tell:

        def tick(iteration: int, report: dict[str, float] | None) -> None:
            tell(iteration, report)
            if _is_orphan():
                os.kill(os.getpid(), signal.SIGTERM)

        yield tick


def _is_orphan() -> bool:
    """Whether this is a launcher's process, and the sweep that it works for was killed."""
    return os.getpid() not in _SWEEPING and os.getppid() != _STARTED_BY


def _divided(words: Sequence[str]) -> tuple[list[str], list[str], Path]:
    """Words with one value, words with several, as Hydra reads them, and the folder of the sweep.

    Raises:
        ConfigError: a key or an option that no run could use.
    """
    defaults = load_config("train")
    fixed, swept, output = list[str](), dict[str, Override](), ""
    for word in words:
        key, _, value = word.partition("=")
        if key == "resume":
            if value != "true":
                raise ConfigError(f"{word}: a sweep goes on with what is not finished; leave it out")
        elif key == "output":
            output = word
        elif (override := _several(word)) is not None:
            swept[word] = override
        else:
            fixed.append(word)
    first = []
    for override in swept.values():
        twice = next((one for one in fixed if one.partition("=")[0] == override.key_or_group), None)
        if twice is not None:
            raise ConfigError(f"{twice}: the key has several values in this command; leave one of the two out")
        group, values = override.key_or_group, [str(value) for value in override.sweep_string_iterator()]
        strange = next((value for value in values if (CONFIG_FOLDER / group).is_dir() and value not in options(group)), None)
        if strange is not None:
            raise ConfigError(unknown(group, strange, options(group)))
        first.append(f"{group}={values[0]}")
    # One value of each key stands for all: what is wrong with another costs its run alone.
    folder = output_folder(load_config("train", [*fixed, *first, output or f"output={_FOLDER}"])).absolute()
    if (folder / "config.yaml").exists():
        raise ConfigError(f"output={folder}: holds a run of its own; give the sweep another output")
    return [read_word(word, defaults)[0] for word in fixed], [*swept], folder


def _several(word: str) -> Override | None:
    """A word that gives a key several values; None for others, and for those that Hydra does not read."""
    try:
        override = parse(word)
    except HydraException:
        return None
    return override if override.is_discrete_sweep() else None


def _require_launcher(hydra: Hydra, words: Sequence[str]) -> None:
    """Raise ConfigError where a launcher is asked for that is not there."""
    name = next((word.partition("=")[2] for word in reversed(words) if word.startswith("hydra/launcher=")), "basic")
    there = [*hydra.config_loader.get_group_options("hydra/launcher", ObjectType.CONFIG), *options("hydra/launcher")]
    if name in there:
        return
    if name in _EXTRAS:
        raise ConfigError(f"hydra/launcher={name}: is a package of its own, which is not installed ({install(_EXTRAS[name])})")
    raise ConfigError(unknown("value for hydra/launcher", name, sorted({*there, *_EXTRAS})))


@contextmanager
def _own_logging() -> Iterator[None]:
    """Hydra sets up Python's logging for a sweep; afterwards it is as before."""
    root = logging.getLogger()
    level, handlers = root.level, root.handlers[:]
    try:
        yield
    finally:
        root.setLevel(level)
        root.handlers[:] = handlers


def _run_name(swept: str) -> str:
    """The name of a run's folder, from the words of its swept keys."""
    name = _FOREIGN.sub("_", re.sub(r"['\"]", "", swept)) or "run"
    return name if len(name) <= _LONGEST else f"{name[:_LONGEST]}_{hashlib.sha256(swept.encode()).hexdigest()[:8]}"


OmegaConf.register_new_resolver("hood_run", _run_name, replace=True)  # also where a launcher's process imports this module
