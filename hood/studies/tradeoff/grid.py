"""Points of the chart of speed against accuracy: which setting on which garments, and the command that measures it."""

from __future__ import annotations

import hashlib
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

from hood.evaluation.table import GUESS, NEWTON, model_name


@dataclass(frozen=True)
class GridSize:
    """Garments of about one size, and what is measured on them.

    Args:
        refine: iterations after the network, each a point of every model and precision.
        guess: iterations of the solver alone.
        models: names of the models that are measured at this size; empty for all.
        precisions: those that are measured at this size; empty for all.
        refined: a model that is measured with further numbers of iterations in the first precision, and these numbers.
        shapes: coefficients of the bodies; every motion is done by each.
    """

    name: str
    garments: tuple[str, ...]
    refine: tuple[int, ...]
    guess: tuple[int, ...]
    num_frames: int
    gap_states: int
    models: tuple[str, ...] = ()
    precisions: tuple[str, ...] = ()
    refined: tuple[str, tuple[int, ...]] = ("", ())
    shapes: tuple[tuple[float, ...], ...] = ((),)

    def iterations(self, model: str) -> list[int]:
        """All that this network is measured with in the first precision, in order."""
        further = self.refined[1] if self.refined[0] in (model, model_name(model)) else ()
        return sorted({*self.refine, *further}) if further else list(self.refine)


@dataclass(frozen=True)
class Point:
    """One setting at one size; exactly one run of ``hood evaluate``.

    Args:
        model: name or path of the weights, or :data:`hood.evaluation.table.GUESS` or :data:`hood.evaluation.table.NEWTON`.
        method: of the refinement.
        settings: ``key=value`` of the command.
        rollouts: how many that makes.
    """

    size: str
    model: str
    refine: int
    precision: str
    method: str
    settings: tuple[str, ...]
    rollouts: int = 1

    @property
    def alone(self) -> bool:
        """Whether the solver does it without a network."""
        return self.model in (GUESS, NEWTON)

    @property
    def name(self) -> str:
        """Of the model: a path's last part that says something."""
        return model_name(self.model)

    @property
    def series(self) -> str:
        """What its line in the chart is called: everything but the iterations."""
        name = "solver alone" if self.alone else f"{self.name} {self.precision}"
        return name if self.method == "newton" else f"{name}, sweeps"

    @property
    def label(self) -> str:
        """Name of the setting, for people."""
        if self.model == NEWTON:
            return "solver alone, converged"
        if self.model == GUESS:
            unit = "sweep" if self.method == "sweeps" else "iteration"
            return f"solver alone, {self.refine} {unit}{'' if self.refine == 1 else 's'}"
        refined = f" + {self.refine}" if self.refine else ""
        swept = " sweeps" if self.method == "sweeps" and self.refine else ""
        return f"{self.name}{refined}{swept}, {self.precision}"

    @property
    def folder(self) -> str:
        """Name of the folder of its measurements: no two points of a grid share one."""
        plain = re.sub(r"[^\w.-]", "_", self.name)
        marked = plain if plain == self.model else f"{plain}-{hashlib.sha256(self.model.encode()).hexdigest()[:6]}"
        return f"{self.size}_{marked}_{self.precision}_{self.method}_{self.refine}"

    @property
    def command(self) -> str:
        """The command line that measures it, for a shell."""
        return shlex.join(["hood", "evaluate", *self.settings])


@dataclass(frozen=True)
class Grid:
    """What is measured: every model in every precision with every method and number of iterations, and the solver alone.

    Args:
        settings: further ``key=value`` of every command: motions, device and the like.
        motions: how many these are.
    """

    models: tuple[str, ...]
    precisions: tuple[str, ...]
    methods: tuple[str, ...]
    sizes: tuple[GridSize, ...]
    settings: tuple[str, ...] = ()
    newton: bool = True
    motions: int = 1

    def points(self) -> list[Point]:
        """All points, small garments first.

        Raises:
            ValueError: two models have one name, or a size wants a model or a precision that is not among them.
        """
        names = [model_name(model) for model in self.models]
        double = [name for name in names if names.count(name) > 1]
        if double:
            raise ValueError(f"models: two of them are called {double[0]!r} and could not be told apart; rename a file")
        return [point for size in self.sizes if size.garments for point in self._points_at(size)]

    def _points_at(self, size: GridSize) -> list[Point]:
        names = {model_name(model): model for model in self.models}
        absent = [name for name in size.models if name not in names and name not in self.models]
        if absent:
            raise ValueError(f"models_{size.name}: {absent[0]!r} is none of the models ({', '.join(names) or 'none'})")
        absent = [name for name in size.precisions if name not in self.precisions]
        if absent:
            raise ValueError(f"precisions_{size.name}: {absent[0]!r} is none of the precisions ({', '.join(self.precisions)})")
        models = [model for name, model in names.items() if not size.models or name in size.models or model in size.models]
        precisions = [name for name in self.precisions if not size.precisions or name in size.precisions]
        points = []
        for model, precision in product(models, precisions):
            for refine in size.iterations(model) if precision == precisions[0] else size.refine:
                # Without iterations the methods are the same.
                methods = self.methods if refine else self.methods[:1]
                points += [self._point(size, model, refine, precision, method) for method in methods]
        points += [self._point(size, GUESS, k, "fp32", method) for k, method in product(size.guess, self.methods)]
        if self.newton:
            points.append(self._point(size, NEWTON, 0, "fp32", "newton"))
        return points

    def _point(self, size: GridSize, model: str, refine: int, precision: str, method: str) -> Point:
        settings = [
            f"models=[{quoted_word(model + (f'+{refine}' if refine else ''))}]",
            f"garments=[{','.join(map(quoted_word, size.garments))}]",
            f"num_frames={size.num_frames}",
            f"gap_states={size.gap_states}",
            *([f"shapes={[list(shape) for shape in size.shapes]}".replace(" ", "")] if size.shapes != ((),) else []),
            *([f"precision={precision}"] if model not in (GUESS, NEWTON) else []),
            *([f"refine_method={method}"] if refine else []),
            *self.settings,
        ]
        rollouts = len(size.garments) * self.motions * len(size.shapes)
        return Point(size.name, model, refine, precision, method, tuple(settings), rollouts)


def quoted_word(text: str) -> str:
    """A value as the grammar of overrides reads it inside a list."""
    if re.fullmatch(r"[\w./:+-]+", text):
        return text
    return "'" + text.replace("'", "\\'") + "'"


def listed_words(key: str, values: Sequence[str]) -> str:
    """``key=[a,b]``."""
    return f"{key}=[{','.join(map(quoted_word, values))}]"
