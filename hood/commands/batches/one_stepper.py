"""``stepper=auto`` over many motions: chosen once, so that what is made in one folder is made in one way."""

from __future__ import annotations

from collections.abc import Sequence

from omegaconf import DictConfig

from hood.commands.automatic import AUTO, choose, decided
from hood.commands.batch import Job
from hood.commands.batches.resuming import as_begun
from hood.commands.setup import make_scene, make_stepper
from hood.commands.steppers import with_stepper


def with_one_stepper(config: DictConfig, jobs: Sequence[Job]) -> DictConfig:
    """The config without ``stepper=auto``, and a line that says why.

    It is the stepper of the rollouts that are finished already where ``resume=true``, else what is chosen for the first motion.
    """
    config = as_begun(config, [(job.sequence, job.folder) for job in jobs])
    settled, why = decided(config)
    if str(settled.stepper) == AUTO:
        first = jobs[0].of(config)
        choice = choose(first, make_stepper(first)[0], make_scene(first))
        settled, why = with_stepper(config, choice.stepper), choice.why
    for sentence in why:
        print(sentence)
    return settled
