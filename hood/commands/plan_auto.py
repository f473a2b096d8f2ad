"""``plan=auto accuracy=…``: a rollout that plans first. Plans are kept by scene, settings and processor."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

from hood import __version__
from hood.commands.common import output_folder
from hood.commands.plan import make_plan
from hood.commands.plan_content import content_digest
from hood.commands.plan_file import FREE, plan_path, read_plan, write_plan
from hood.commands.plan_table import sentence
from hood.config import ConfigError, load_config, with_words
from hood.native.build import processor
from hood.native.cache import cache_folder


def planned(overrides: Sequence[str]) -> list[str]:
    """The words of a rollout; with ``accuracy`` its plan is made, or found where it was kept, and stands in them.

    A plan lies in the user's cache folder, or beside the rollout where nothing may be kept.

    Raises:
        ConfigError: ``accuracy`` beside a plan that is not ``auto``, and what ``hood plan`` refuses.
    """
    config = load_config("rollout", overrides)
    if config.accuracy is None:
        return list(overrides)
    if plan_path(config) is not None or str(config.plan) == "full":
        raise ConfigError(f"accuracy={config.accuracy}: belongs to plan=auto, not to plan={config.plan}; drop one of the two")
    rest = [word for word in overrides if _key(word) not in ("accuracy", "plan")]
    words = [word for word in rest if _key(word) not in FREE or _key(word) == "num_frames"]
    own = with_words(load_config("plan"), [f"accuracy={config.accuracy}"])
    cache = cache_folder()
    path = (output_folder(config) if cache is None else cache / "plans") / f"plan-{_digest(words, str(config.accuracy))}.json"
    if path.is_file():
        plan = read_plan(path)
        print(f"plan of {path}, made before")
    else:
        plan, _ = make_plan(words, own, evidence=False)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_plan(path, plan)
        print(f"planned in {plan['seconds']:.1f} s, kept in {path}")
    print(sentence(plan))
    return [*rest, f"plan='{path}'"]


def _key(word: str) -> str:
    return word.partition("=")[0].lstrip("+~")


def _digest(words: Sequence[str], accuracy: str) -> str:
    """Of everything that a plan depends on, the processor that its times are of among it."""
    said = [__version__, processor(), accuracy, str(load_config("rollout", words).stepper), content_digest(words)]
    return hashlib.sha256("\0".join(said).encode()).hexdigest()[:24]
