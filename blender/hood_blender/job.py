"""Work that goes on beside the interface: a generator that a timer of Blender moves on, one for every scene."""

from __future__ import annotations

import time
import traceback
from collections.abc import Iterator

import bpy

from .fault import BakeError, Fault
from .plan import Progress

#: Of a tenth of a second so much is work [s]; the rest is the user's.
_SLICE, _PAUSE = 0.06, 0.02
_CANCELLED = "Cancelled; frames that are there stay"
#: Jobs by scene, running or ended: what the panel shows.
_JOBS: dict[str, Job] = {}


class Job:
    """One piece of work.

    Args:
        steps: yields how long nothing has to be done [s]; raises BakeError where it cannot go on.
    """

    def __init__(self, steps: Iterator[float], progress: Progress) -> None:
        self._steps, self.progress = steps, progress
        self.running, self.error, self.cancelled = True, "", False
        self._rest = 0.0

    def move_on(self) -> float | None:
        """Work for a moment; returns when to come again [s], None at the end."""
        until = time.monotonic() + _SLICE
        while self.running:
            try:
                wait = next(self._steps)
            except StopIteration:
                self.running = False
                self.progress.work = _CANCELLED if self.cancelled else self.progress.work
            except BakeError as error:
                self._fail(str(error), error)
            except Exception as error:  # a mistake of the add-on must not stop Blender's timers in silence
                traceback.print_exc()
                self._fail(f"{type(error).__name__}: {error}; the console says more", None)
            else:
                if wait or time.monotonic() > until:
                    return max(wait, _PAUSE)
        redraw()
        return None

    def _fail(self, sentence: str, error: BakeError | None) -> None:
        self.running, self.error = False, sentence
        if not any(fault.text == sentence for fault in self.progress.faults):
            named = error or BakeError(sentence)
            self.progress.faults.insert(0, Fault(sentence, named.garment, None, named.vertices, named.faces))

    def cancel(self) -> None:
        """End it; finished frames stay. A process is asked to end, and the job goes on until it has."""
        if not self.running:
            return
        self.cancelled = self.progress.cancel = True
        if not self.progress.runs:
            self.end()

    def end(self) -> None:
        """End it now; a process that runs is waited for."""
        if self.running:
            self.running = False
            self._steps.close()  # type: ignore[attr-defined]
            self.progress.work = _CANCELLED

    def wait(self) -> None:
        """Go on to the end without an interface."""
        while (pause := self.move_on()) is not None:
            time.sleep(min(pause, 0.1))


def start(scene: str, steps: Iterator[float], progress: Progress, wait: bool = False) -> Job:
    """Begin work for a scene."""
    job = _JOBS[scene] = Job(steps, progress)
    if wait:
        job.wait()
    else:
        bpy.app.timers.register(lambda: _tick(job), first_interval=0.0)
    return job


def _tick(job: Job) -> float | None:
    redraw()
    return job.move_on()


def job_of(scene: str) -> Job | None:
    """The last job of a scene."""
    return _JOBS.get(scene)


def cancel_all() -> None:
    """End all that runs."""
    for job in _JOBS.values():
        job.end()


def redraw() -> None:
    """Show the sidebar and the garments anew."""
    for window in getattr(bpy.context.window_manager, "windows", ()):
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()
