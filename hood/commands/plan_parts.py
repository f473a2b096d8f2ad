"""The parts of a rollout's model that can be left out or coarsened, each as words of the command line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from omegaconf import DictConfig

from hood.assets.files.library import unknown
from hood.commands.cloth_contact import acts
from hood.commands.refinement import chosen
from hood.config import ConfigError, build
from hood.losses.collision import Collision


@dataclass(frozen=True)
class Part:
    """A part of the model.

    Args:
        purpose: what it is for.
        words: the settings without it.
        term: the energy of the potential that it is; "" where it is none.
        rivals: parts of one such name exclude each other.
        watched: whether a rollout notices where it was wrong to leave the part out; others are measured and kept.
        stays: why one that is noticed is kept all the same; "" where it is not.
    """

    name: str
    purpose: str
    words: tuple[str, ...]
    term: str = ""
    rivals: str = ""
    watched: bool = True
    stays: str = ""


def _has(name: str) -> Callable[[DictConfig], bool]:
    return lambda config: config.losses.terms.get(name) is not None


def _solver(config: DictConfig) -> bool:
    return str(config.stepper) == "newton"


def _bulges(config: DictConfig) -> bool:
    return _collision(config, "reach", "curvature")


def _folds(config: DictConfig) -> bool:
    return _collision(config, "sides", "both")


def _collision(config: DictConfig, key: str, value: str) -> bool:
    term = build(config.losses).terms.get("collision")
    return isinstance(term, Collision) and getattr(term, key, None) == value


def _iterations(config: DictConfig) -> int:
    """Iterations after the network, or from the guess; 0 where none are counted."""
    asked = None if _solver(config) else chosen(config)
    return int(asked[1]) if asked is not None and asked[0] == "refine" else 0


def _target(share: float) -> Callable[[DictConfig], bool]:
    return lambda config: _solver(config) and float(config.solver.target_rg) < share


#: Part, and whether a settled config has it.
_TERMS: tuple[tuple[Part, Callable[[DictConfig], bool]], ...] = (
    (Part("bending", "folds are wide, not sharp", ("losses.terms.bending=null",), "bending"), _has("bending")),
    (Part("friction", "cloth hangs on the skin", ("losses.terms.friction=null",), "friction", "body"), _has("friction")),
    (
        Part(
            "body contact", "cloth stays off the body", ("losses.terms.friction=null", "losses.terms.collision=null"),
            "collision", "body",
        ),
        _has("collision"),
    ),
    (
        Part(
            "bulges", "long edges do not cut bulges", ("losses.terms.collision.reach=constant",), "collision", watched=False
        ),
        _bulges,
    ),
    (
        Part(
            "skin folds", "cloth is off both sides of a fold", ("losses.terms.collision.sides=nearest",), "collision",
            watched=False,
        ),
        _folds,
    ),
    (
        Part(
            "cloth contact", "layers of cloth stay apart", ("cloth_contact=off",), "layers",
            stays="where layers meet nothing it is only the check that they do, which nothing can replace",
        ),
        acts,
    ),
    (Part("gravity", "weight", ("gravity=0",), "gravity", watched=False), lambda config: float(config.gravity) > 0.0),
)  # fmt: skip
_ACCURACY: tuple[tuple[Part, Callable[[DictConfig], bool]], ...] = (
    (Part("last iterations", "forces balanced to 3%", ("solver.target_rg=0.03",), rivals="target"), _target(0.03)),
    (Part("later iterations", "forces balanced to 10%", ("solver.target_rg=0.1",), rivals="target"), _target(0.1)),
)


def parts_of(config: DictConfig) -> list[Part]:
    """The parts that a settled config of ``hood rollout`` has."""
    found = [part for part, there in (*_TERMS, *_ACCURACY) if there(config)]
    iterations = _iterations(config)
    for count in sorted({iterations // 2, 1} - {0, iterations}, reverse=True) if iterations else []:
        words = (f"refine={count}",)
        found.append(Part(f"iterations above {count}", "refinement of every step", words, rivals="refine"))
    if str(config.stepper) == "network" and str(config.precision) == "fp32":
        found.append(Part("float32", "latents and products in full precision", ("precision=bf16",)))
    return found


def choose_parts(config: DictConfig, names: list[str]) -> list[Part]:
    """Those of the names; all where none is given.

    Raises:
        ConfigError: a part that this rollout does not have, or none at all.
    """
    there = {part.name: part for part in parts_of(config)}
    for name in names:
        if name not in there:
            raise ConfigError(unknown("part", name, list(there)))
    return [there[name] for name in names] if names else list(there.values())
