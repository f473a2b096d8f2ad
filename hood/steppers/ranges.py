"""What weights were trained for, and which values of a scene lie outside it.

The ranges travel with the weights: training writes them into the model file, :attr:`NetworkStepper.trained_for` holds them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from hood.assets.garment.garment import Garment
from hood.assets.material import RANGES, UNITS, WEAVE, Material, values_of
from hood.assets.motion.motion_files import MotionFiles
from hood.assets.motion.sequence import PoseSequence
from hood.cloth.cloth import Cloth
from hood.energies.potential import Potential
from hood.energies.problem import STANDARD_GRAVITY
from hood.energies.term import kind_in_file
from hood.mesh.topology import connected_components, unique_edges
from hood.scene.sizing import Sizes

#: A value this share beyond an end of its range is on it: float32 and text have rounded.
_ROUNDING = 1e-4
#: Names in sentences, of quantities that are no keys of a command.
_TITLES = {"vertices": "garment vertices", "edge_length": "garment mean edge", "size": "garment size"}

#: Settings of terms that files from before them do not name, and what these files were trained with.
_LATER = {
    kind: {"contact": "vertices", "reach": "constant", "sides": "nearest"}
    for kind in ("Collision", "CentroidCollision", "Friction")
}
#: Settings that weights take as they are, whatever they were trained with: figures in hood/studies/notes/contact.md.
_TAKEN = ("reach", "sides")

_Span = tuple[float, float]

#: What all trainings have had, those of files that do not say included.
_USUAL: dict[str, _Span] = {"gravity": (STANDARD_GRAVITY, STANDARD_GRAVITY), "material.friction": (1.0, 1.0)}
_USUAL |= {f"material.{name}": (1.0, 1.0) for name in WEAVE}


@dataclass(frozen=True)
class Conditions:
    """Least and greatest values by quantity, of a training or of a scene, and the potential's settings.

    Quantities: ``fps`` [1/s]; ``gravity`` [m/s²]; ``material.NAME`` [SI]; ``vertices`` of the largest connected piece of a
    garment; ``edge_length`` [m], the mean of a garment's edges at rest, before it grows with a body; ``size``, a factor on the
    garment; ``betas``, shape coefficients. Those that a scene does not have (no parametric body) are absent.
    """

    spans: Mapping[str, _Span]
    potential: Mapping[str, Mapping[str, Any]]  # see Potential.settings

    def to_json(self) -> str:
        """One line that :meth:`from_json` reads back exactly."""
        return json.dumps({"spans": self.spans, "potential": self.potential})

    @staticmethod
    def from_json(text: str) -> Conditions:
        """The inverse of :meth:`to_json`.

        Raises:
            ValueError: the text is something else.
        """
        try:
            content = json.loads(text)
            spans = {str(name): (float(low), float(high)) for name, (low, high) in content["spans"].items()}
            terms = {str(name): dict(term) for name, term in content["potential"].items()}
            potential = {name: _as_written_today(term) for name, term in terms.items()}
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ValueError(f"training ranges cannot be read ({type(error).__name__}: {error})") from error
        wrong = next((name for name, span in spans.items() if not (np.isfinite(span).all() and span[0] <= span[1])), None)
        if wrong is not None:
            raise ValueError(f"training range {wrong!r} is {list(spans[wrong])}, no range of finite numbers")
        return Conditions(spans, potential)


def _as_written_today(term: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a term from a file of any age."""
    kind = kind_in_file(str(term.get("term", "")))
    return {**_LATER.get(kind, {}), **term, **({"term": kind} if kind else {})}


class Sampling(Protocol):
    """What is asked of those who draw scenes for training, see :class:`hood.training.scenes.SceneSampler`."""

    size_low: float
    size_high: float
    beta_range: float
    material: Material | None

    @property
    def garments(self) -> Sequence[Garment]:
        """Those that are drawn from."""

    @property
    def sequences(self) -> MotionFiles | Sequence[PoseSequence]:
        """Motions that windows are cut from."""


def scene_conditions(
    garment: Garment,
    cloth: Cloth,
    dt: float,
    potential: Potential,
    betas: np.ndarray | None = None,
    gravity: float = STANDARD_GRAVITY,
    sizes: Sizes | None = None,
) -> Conditions:
    """What a garment of the fabric of ``cloth`` asks of a model, in steps of ``dt`` [s], at the size it has or at ``sizes``, on
    a body of shape ``betas`` (S,), under ``gravity`` [m/s²]."""
    factors = (1.0,) if sizes is None else (*sizes.start, *sizes.end, *sizes.parts)
    size = min(factors), max(factors)
    spans: dict[str, _Span] = {"fps": (1.0 / dt, 1.0 / dt), "size": size, "gravity": (gravity, gravity)}
    fabric = {name: getattr(cloth, name) for name in Material.names() if name not in WEAVE}
    weave = cloth.rest_area.new_ones(1, 3) if cloth.weave is None else cloth.weave
    fabric |= dict(zip(WEAVE, weave.unbind(dim=1), strict=True))
    spans |= {f"material.{name}": _extent(values) for name, values in fabric.items() if values.numel()}
    spans |= _resolution([garment])
    if betas is not None and len(betas):
        spans["betas"] = (float(np.min(betas)), float(np.max(betas)))
    return Conditions(spans, potential.settings)


def training_conditions(sampler: Sampling, potential: Potential) -> Conditions:
    """What a model sees that is trained with ``potential`` on the scenes of ``sampler``."""
    low, high = sampler.size_low, sampler.size_high
    motions = sampler.sequences
    fps = [motions.fps] if isinstance(motions, MotionFiles) else [motion.fps for motion in motions]
    spans: dict[str, _Span] = {"fps": (min(fps), max(fps)), "size": (low, high), **_USUAL}
    spans["betas"] = (-sampler.beta_range, sampler.beta_range)
    spans |= {f"material.{name}": span for name, span in _fabrics(sampler.material).items()}
    spans |= _resolution(sampler.garments)
    spans["edge_length"] = (low * spans["edge_length"][0], high * spans["edge_length"][1])
    return Conditions(spans, potential.settings)


def outside(trained: Conditions, asked: Conditions) -> list[str]:
    """One sentence for every quantity and every setting of the potential that ``asked`` has outside of ``trained``."""
    sentences = []
    for name, (low, high) in {**_USUAL, **trained.spans}.items():
        least, most = asked.spans.get(name, (low, high))
        too_high, too_low = most > high + _ROUNDING * abs(high), least < low - _ROUNDING * abs(low)
        if too_high or too_low:
            value = most if too_high else least
            title = _TITLES.get(name, name)
            sentences.append(f"{title}={_range(name, (value, value))} (trained on {_range(name, (low, high))})")
    known = {
        name: {key: asked.potential.get(name, {}).get(key, value) if key in _TAKEN else value for key, value in term.items()}
        for name, term in trained.potential.items()
    }
    return sentences + different(known, asked.potential)


def different(
    known: Mapping[str, Mapping[str, Any]], asked: Mapping[str, Mapping[str, Any]], word: str = "trained on"
) -> list[str]:
    """The same for the settings of two potentials alone: terms of another class, absent and further ones, other values.

    ``word`` says what the ``known`` ones are.
    """
    sentences = []
    for name in dict.fromkeys([*known, *asked]):
        was, now = known.get(name, {}), asked.get(name, {})
        if was.get("term") != now.get("term"):
            kinds = [str(one.get("term", "none")).rpartition(".")[2] for one in (now, was)]
            sentences.append(f"losses.terms.{name}={kinds[0]} ({word} {kinds[1]})")
            continue
        sentences += [
            f"losses.terms.{name}.{key}={_number(now.get(key))} ({word} {_number(was.get(key))})"
            for key in dict.fromkeys([*was, *now])
            if not _same(was.get(key), now.get(key))
        ]
    return sentences


def describe_conditions(trained: Conditions | None) -> dict[str, str]:
    """The ranges in words, by the name that a command or a sentence uses; ``unknown`` where a file says nothing."""
    if trained is None:
        return {"trained on": "unknown, the file does not say"}
    spans = {f"trained on {_TITLES.get(name, name)}": _range(name, span) for name, span in trained.spans.items()}
    terms = [
        f"{name}({', '.join(f'{key}={_number(value)}' for key, value in term.items() if key != 'term')})"
        for name, term in trained.potential.items()
    ]
    return spans | {"trained on losses": ", ".join(term.removesuffix("()") for term in terms)}


def _fabrics(material: Material | None) -> dict[str, _Span]:
    """Extent of every property of a fabric; None: of those that are sampled."""
    given = {name: values_of(getattr(material or Material(), name))[0] for name in Material.names()}
    spans = {name: (float(values.min()), float(values.max())) for name, values in given.items()}
    return spans if material is not None else spans | RANGES


def _resolution(garments: Iterable[Garment]) -> dict[str, _Span]:
    """Spans of ``vertices`` and ``edge_length``."""
    counts, lengths = [], []
    for garment in garments:
        pos, edges = garment.rest_pos, unique_edges(garment.faces)
        counts.append(float(np.bincount(connected_components(len(pos), edges)).max()))
        lengths.append(float(np.linalg.norm(pos[edges[:, 0]] - pos[edges[:, 1]], axis=1).mean()))
    return {"vertices": (min(counts), max(counts)), "edge_length": (min(lengths), max(lengths))}


def _extent(values: Tensor) -> _Span:
    low, high = torch.aminmax(values)
    return float(low), float(high)


def _range(name: str, span: _Span) -> str:
    forms: dict[str, Callable[[float], str]] = {"vertices": "{:,.0f}".format, "edge_length": lambda m: f"{1e3 * m:.3g}"}
    low, high = map(forms.get(name, "{:.5g}".format), span)
    unit = "mm" if name == "edge_length" else UNITS.get(name.removeprefix("material."), "")
    return f"{low if low == high else f'{low} to {high}'} {unit}".rstrip()


def _number(value: Any) -> str:
    return f"{value:g}" if isinstance(value, (int, float)) and not isinstance(value, bool) else str(value).lower()


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, float) or isinstance(b, float):
        return a is not None and b is not None and math.isclose(a, b, rel_tol=_ROUNDING)
    return bool(a == b)
