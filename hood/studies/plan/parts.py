"""The parts of a rollout's model that can be left out or coarsened, each as words of the command line."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

from hood.app.settings.compose import ConfigError, plain
from hood.app.settings.rollout_settings import RolloutSettings, cloth_contact, fixed_shapes, overrides, with_value
from hood.app.stepping.cloth_contact import acts
from hood.app.stepping.refinement import chosen
from hood.app.stepping.steppers import losses_of
from hood.assets.files.library import unknown
from hood.energies.term import Role, role_of


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
        instead: the name is that of another way to take the steps, not of what is left out.
        refitted: the words change the fabric, so the cloth is made anew with them.
    """

    name: str
    purpose: str
    words: tuple[str, ...]
    term: str = ""
    rivals: str = ""
    watched: bool = True
    stays: str = ""
    instead: bool = False
    refitted: bool = False


#: Iterations after the inertial guess, and after a network, that are measured as ways to take the steps.
_FROM_GUESS, _FROM_NETWORK = (8, 4, 2), (0, 5)


def _has(name: str) -> Callable[[RolloutSettings], bool]:
    return lambda config: config.losses.terms.get(name) is not None


def _solver(config: RolloutSettings) -> bool:
    return str(config.stepper) == "newton"


def _bulges(config: RolloutSettings) -> bool:
    return _collision(config, "reach", "curvature")


def _folds(config: RolloutSettings) -> bool:
    return _collision(config, "sides", "both")


def _collision(config: RolloutSettings, key: str, value: str) -> bool:
    term = losses_of(config).terms.get("collision")
    return term is not None and role_of(term) is Role.CONTACT and getattr(term, key, None) == value


def _iterations(config: RolloutSettings) -> int:
    """Iterations after the network, or from the guess; 0 where none are counted."""
    asked = None if _solver(config) else chosen(config)
    return int(asked.value) if asked is not None and not asked.unit else 0


def _target(share: float) -> Callable[[RolloutSettings], bool]:
    return lambda config: _solver(config) and float(config.solver.target_rg) < share


def _given(key: str) -> Callable[[RolloutSettings], bool]:
    return lambda config: config.get(key) is not None


def _by_factors(config: RolloutSettings) -> bool:
    # Measured cloth has a shear stiffness of the same name.
    material = config.material
    return "woven" not in material and any(float(material.get(name, 1.0)) != 1.0 for name in ("warp", "weft", "shear"))


#: Words that make woven cloth isotropic: measured cloth, and fabrics with factors.
_MEASURED, _FACTORS = ("material.woven=false",), ("material.warp=1", "material.weft=1", "material.shear=1")
#: Part, and whether a settled config has it.
_TERMS: tuple[tuple[Part, Callable[[RolloutSettings], bool]], ...] = (
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
    (Part("air", "wind pushes, still air brakes", ("losses.terms.air=null",), "air"), _given("wind")),
    (
        Part(
            "damping", "vibrations die", ("losses.terms.stretch_damping=null", "losses.terms.bend_damping=null"),
            "stretch_damping",
        ),
        lambda config: float(config.damping) > 0.0,
    ),
    (Part("gravity", "weight", ("gravity=0",), "gravity", watched=False), lambda config: float(config.gravity) > 0.0),
)  # fmt: skip
#: Of the fabric. Their rows are evidence: no energy is left out whose return would be noticed.
_FABRIC: tuple[tuple[Part, Callable[[RolloutSettings], bool]], ...] = (
    (
        Part("fabrics of parts", "parts are of other cloth", ("fabrics=null",), watched=False, refitted=True),
        _given("fabrics"),
    ),
    (
        Part(
            "friction of body parts",
            "parts of the body grip or slide",
            ("body_friction=null",),
            "friction",
            watched=False,
            refitted=True,
        ),
        _given("body_friction"),
    ),
    (
        Part("warp and weft", "threads stretch less than they shear", _MEASURED, watched=False, refitted=True),
        lambda config: config.material.get("woven") is True,
    ),
    (
        Part("warp and weft", "threads stretch less than they shear", _FACTORS, watched=False, refitted=True),
        _by_factors,
    ),
)
_ACCURACY: tuple[tuple[Part, Callable[[RolloutSettings], bool]], ...] = (
    (Part("last iterations", "forces balanced to 3%", ("solver.target_rg=0.03",), rivals="steps"), _target(0.03)),
    (Part("later iterations", "forces balanced to 5%", ("solver.target_rg=0.05",), rivals="steps"), _target(0.05)),
)


def parts_of(config: RolloutSettings, steppers: bool = False) -> list[Part]:
    """The parts that a settled config of ``hood rollout`` has; with ``steppers`` other ways to take its steps as well."""
    found = [part for part, there in (*_TERMS, *_FABRIC, *_ACCURACY) if there(config)]
    mode, friction = cloth_contact(config)
    if friction and acts(config):  # before contact itself, whose words then count
        words: tuple[str, ...] = (f"cloth_contact={mode}",)
        found.insert(0, Part("cloth friction", "layers hang on each other", words, "layers", watched=False))
    iterations = _iterations(config)
    for count in sorted({iterations // 2, 1} - {0, iterations}, reverse=True) if iterations else []:
        words = tuple(overrides({"refine": with_value(plain(config.refine), "goal", count)}))
        found.append(Part(f"iterations above {count}", "refinement of every step", words, rivals="steps"))
    if str(config.stepper) == "network" and str(config.precision) == "fp32":
        found.append(Part("float32", "latents and products in full precision", ("precision=bf16",)))
    return [*found, *_steppers(config)] if steppers else found


def _steppers(config: RolloutSettings) -> list[Part]:
    """Other ways to take the steps: of a solver a network and fewer iterations, of a network the solver."""
    goal = chosen(config)
    if (goal is not None and goal.unit) or fixed_shapes(config):
        return []
    asked = str(config.stepper)
    ways: list[tuple[str, str, tuple[str, ...]]] = []
    if asked == "newton":
        for count in _FROM_GUESS:
            ways.append((f"{count} iterations", "from the inertial guess", ("stepper=refine", f"refine={count}")))
        for count in _FROM_NETWORK:
            name = "network" if count == 0 else f"network with {count} iterations"
            purpose = f"steps of {config.checkpoint}" + (", refined" if count else "")
            ways.append((name, purpose, ("stepper=network", f"refine={count}")))
    elif asked == "network":
        ways.append(("newton", "steps by the solver alone", ("stepper=newton", "refine=0")))
    return [Part(name, purpose, words, rivals="steps", instead=True) for name, purpose, words in ways]


def choose_parts(config: RolloutSettings, names: list[str], steppers: bool = False, others: Collection[str] = ()) -> list[Part]:
    """Those of the names; where none is given all, other ways to take the steps if ``steppers``.

    Args:
        others: names that may be asked for and are no parts.

    Raises:
        ConfigError: a part that this rollout does not have.
    """
    there, names = {part.name: part for part in parts_of(config, True)}, list(dict.fromkeys(names))
    for name in names:
        if name not in there and name not in others:
            raise ConfigError(unknown("part", name, [*there, *others]))
    return [there[name] for name in names if name in there] if names else parts_of(config, steppers)
