"""``hood rollout``, ``hood dress``, ``hood fit`` and ``hood train``: progress bars and exit codes of :mod:`hood.app.rollout`,
:mod:`hood.app.batch.dress`, :mod:`hood.app.fit` and :mod:`hood.app.train`.

Each command imports what the others do without when it is called.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from tqdm import tqdm

from hood.app.notices import Item
from hood.app.output.verdict import exit_code
from hood.app.rollout import Rollouts, rollout
from hood.training import distributed

if TYPE_CHECKING:
    from hood.app.train import Tick


def run(overrides: Sequence[str]) -> int:
    """Run the command; returns the exit code: 130 where the user interrupted it, else 2 where a motion of many could not be
    used, else 3 where a result is unsound (:mod:`hood.rollouts.verdict`), else 0."""
    return code_of(rollout(overrides, bar))


def bar(items: Iterable[Item], total: int, what: str) -> Iterable[Item]:
    """A progress bar, shown on a terminal, by one process."""
    shown: Iterable[Item] = tqdm(items, total=total, desc=what, unit="frame", disable=True if distributed.rank() else None)
    return shown


def code_of(done: Rollouts) -> int:
    """The exit code; what there is to say of it is printed."""
    if done.interrupted:
        return 130
    if any("error" in summary for summary in done.summaries):
        return 2
    code, said = exit_code(done.summaries, str(done.config.fail_on))
    for sentence in said:
        print(f"hood: {sentence}", file=sys.stderr)
    return code


def dressed(overrides: Sequence[str]) -> int:
    """Run the command; returns the exit code: 130 where the user interrupted it, else 2 where more rows failed than
    ``fail_fraction`` says, else 3 where more are unsound, else 0."""
    from hood.app.batch.dress import dress_rows

    return dress_rows(overrides).code


def fitted(overrides: Sequence[str]) -> int:
    """Run ``hood fit``; returns the exit code: 130 where the user interrupted it, 3 where it has not converged, else 0."""
    from hood.app.fit import run_fit

    return run_fit(overrides).code


def train(overrides: Sequence[str]) -> int:
    """Run the command; returns the exit code: 130 where the user interrupted it, else 2 where a run of a sweep failed, else
    0."""
    from hood.app.sweep import is_sweep, run_sweep
    from hood.app.train import train as trained

    if not is_sweep(overrides):
        return 130 if trained(overrides, training_bar).interrupted else 0
    from hood.cli.compare import table_of_runs

    done = run_sweep(overrides)
    print("\n".join(table_of_runs(done.runs) if done.runs else ["no run has begun"]), flush=True)
    for folder, reason in done.failed.items():
        print(f"hood: {folder.name}: {reason}", file=sys.stderr)
    if done.interrupted:
        print("hood: interrupted; the same command again goes on", file=sys.stderr)
    return 130 if done.interrupted else 2 if done.failed else 0


@contextmanager
def training_bar(total: int, done: int) -> Iterator[Tick]:
    """A progress bar of ``total`` iterations, shown on a terminal, by one process."""
    quiet = distributed.rank() != 0 or None
    with tqdm(total=total, initial=done, desc="train", unit="it", disable=quiet) as shown:

        def tick(iteration: int, report: dict[str, float] | None) -> None:
            if report is None:
                shown.unpause()  # a validation is no part of the rate
                return
            shown.update(iteration - shown.n)
            if iteration % 20 == 0:
                shown.set_postfix(rg=f"{report['relative_gradient']:.2f}", horizon=int(report["horizon"]), refresh=False)

        yield tick
