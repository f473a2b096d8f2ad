"""``hood fit``: fabric, size, friction and wind from frames that were seen.

The frames are simulated again and again with other values, until they lie on the observed ones
(:mod:`hood.evaluation.fitting`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from omegaconf import DictConfig, OmegaConf

from hood.app.common import output_folder, prepare_folder
from hood.app.notices import collected, heard, say
from hood.app.settings.compose import ConfigError, load_config, named_today, plain, shown
from hood.app.settings.rollout_settings import RolloutSettings, overrides
from hood.app.setup import Setup, check_config, make_stepper, set_up, start_of
from hood.app.stepping.cautions import idle_in_rollout
from hood.assets.files.atomic import occupy, write_atomically
from hood.assets.files.library import unknown
from hood.assets.files.said import unheard
from hood.evaluation.fitting import Minimum, Observed, Unknown, estimates, fit_steps, observed_frames, seen_ratios
from hood.rollouts.equilibrium import relaxed_from
from hood.rollouts.file.reader import RolloutData
from hood.rollouts.file.recorder import still_of
from hood.rollouts.loop import own_start, simulate


class _Kind(NamedTuple):
    """A parameter: the key of ``hood rollout`` that has it, its bounds, whether its logarithm is fitted, its unit."""

    key: str
    lower: float
    upper: float
    log: bool = True
    unit: str = ""


#: What can be fitted. Bounds are told in configs/fit.yaml.
KINDS = {
    "density": _Kind("material.density", 0.01, 5.0, unit="kg/m²"),
    "lame_mu": _Kind("material.lame_mu", 1e2, 1e7, unit="Pa"),
    "lame_lambda": _Kind("material.lame_lambda", 1e2, 1e7, unit="Pa"),
    "bending_stiffness": _Kind("material.bending_stiffness", 1e-8, 0.1, unit="J"),
    "friction": _Kind("material.friction", 0.01, 10.0),
    "damping": _Kind("damping", 1e-5, 0.1, unit="s"),
    "size": _Kind("size", 0.5, 2.0),
    "wind_x": _Kind("wind", -30.0, 30.0, log=False, unit="m/s"),
    "wind_y": _Kind("wind", -30.0, 30.0, log=False, unit="m/s"),
    "wind_z": _Kind("wind", -30.0, 30.0, log=False, unit="m/s"),
}
_SEVERAL = {"fabric": [*KINDS][:4], "wind": [*KINDS][-3:]}
#: Of every rollout, before the words that are given.
_USUAL = ("stepper=newton", "solver.target_rg=1e-7", "metrics=none", "guard=off", "video=none")
#: Keys of a rollout that a fit has no use for.
_IDLE = ("resume", "root", "formats", "output_fps", "refine_mesh", "sheet", "colour", "texture", "plan", "size_end")
_LEAST_NOISE, _SHEET = 1e-5, 5
_MEASURED_START = 16.0  # variances are larger where cloth starts from a measured frame: by nine dresses (notes/fabrics.md)


@dataclass(frozen=True)
class Fitted:
    """What came of a fit: the content of ``fit.json``, where it lies, and whether the user interrupted it."""

    content: dict[str, Any]
    folder: Path
    interrupted: bool

    @property
    def code(self) -> int:
        """The exit code."""
        return 130 if self.interrupted else 0 if self.content["converged"] else 3


def fit(observed: Any = None, *, tell: Callable[[str], None] | None = None, **keys: Any) -> dict[str, Any]:
    """Run ``hood fit`` with its keys: what cloth is made of, from frames that were seen. Nothing is printed.

    Args:
        observed: a file or folder as of ``hood fit``, or the frames: (T, V, 3) m with rows of NaN where nothing was seen, or
            with ``points=True`` a list of arrays (P, 3).
        tell: is called with every line that the command prints: ``tell=print``.
        keys: those of ``hood fit --help`` and ``hood rollout --help``, such as ``parameters=["lame_mu"], garment="dress"``.

    Returns:
        What ``fit.json`` holds: ``parameters`` with value, interval and whether the data tell it, ``said``, ``converged``.

    Raises:
        ValueError, OSError: keys, files or frames that cannot be used.
        KeyboardInterrupt: it was interrupted; ``fit.json`` has the best values so far.

    Examples:
        >>> import hood
        >>> seen = [frame.world_pos.numpy() for frame in hood.simulate("tank", size=1.05, num_frames=2, stepper="newton")]
        >>> found = hood.fit(seen, parameters=["size"], garment="tank", guess={"size": 1.0}, output="outputs/fitted")
        >>> abs(found["parameters"]["size"]["value"] - 1.05) < 0.005
        True
    """
    given = isinstance(observed, (str, Path)) or observed is None
    named = keys if observed is None else {**keys, "observed": str(observed) if given else "frames"}
    with collected(tell):
        done = run_fit(overrides(named), None if given else observed)
    if done.interrupted:
        raise KeyboardInterrupt
    return done.content


def run_fit(words: Sequence[str], frames: Any = None) -> Fitted:
    """Run what the words of ``hood fit`` ask for; ``frames`` stand for ``observed``.

    Raises:
        ConfigError, ValueError, OSError: words, files or frames that cannot be used.
    """
    config, given = _split(words)
    names = _names(config)
    settings = RolloutSettings.from_words([*_USUAL, *given])
    unknowns = _unknowns(config, settings, names)
    if frames is None and config.observed is None:
        raise ConfigError("observed: nothing was observed; give rollout.h5 or a folder: hood fit observed=scans garment=dress")
    seen, loss = str(config.observed) if frames is None else frames, (bool(config.whole), float(config.huber or math.inf))
    observed = observed_frames(seen, bool(config.points), int(config.most_points), *loss)
    if "num_frames" in {word.partition("=")[0] for word in given}:
        last = (int(settings.num_frames) - int(config.first) - 1) // int(config.every)
        observed = replace(observed, frames=observed.frames[: max(last, 0) + 1])
    settings = settings.with_values(num_frames=int(config.first) + int(config.every) * (len(observed.frames) - 1) + 1)
    check_config(settings)
    for sentence in idle_in_rollout(["stepper=newton", *given], settings):
        say(sentence)
    measured = bool(config.from_first) if config.from_first is not None else bool({*names} & {*_SEVERAL["fabric"]})
    scene = _Scene(settings, observed, int(config.first), int(config.every), measured)
    scene.check({one.name: one.guess for one in unknowns})
    if config.from_first and not scene.from_first:
        raise ConfigError("from_first=true: is for worn cloth of which all vertices were seen in frame 0; leave it out")
    folder = prepare_folder(output_folder(config))
    with occupy(folder):
        return _Fit(config, scene, unknowns, given, folder).run()


def _split(words: Sequence[str]) -> tuple[DictConfig, list[str]]:
    """The command's own config, checked, and the words of its rollouts."""
    own, theirs = [str(key) for key in load_config("fit")], [str(key) for key in load_config("rollout")]
    mine, others = list[str](), list[str]()
    for word in words:
        key = word.partition("=")[0].lstrip("+~")
        if key in _IDLE:
            raise ConfigError(f"{word}: hood fit has no use for it; leave it out")
        if "=" in word and key.split(".")[0] not in (*own, *theirs):
            raise ConfigError(unknown("key", key, [*own, *theirs]))
        (mine if key in own or "=" not in word or word.startswith("-") else others).append(word)
    config = load_config("fit", mine)
    for key, least in (("first", 0), ("every", 1), ("most_points", 1), ("most_steps", 1)):
        if int(config[key]) < least:
            raise ConfigError(f"{key}={config[key]}: must be at least {least}")
    for key in ("noise", "huber"):
        length = config[key]
        if length is not None and not (isinstance(length, (int, float)) and length > 0):
            raise ConfigError(f"{key}={shown(length)}: give metres above 0, such as {key}=0.02")
    if config.whole and not config.points:
        raise ConfigError("whole=true: is for points=true; vertices are compared one by one")
    windows = plain(config.windows)
    if not windows or not all(isinstance(share, (int, float)) and 0 < share <= 1 for share in windows) or windows[-1] != 1:
        raise ConfigError(f"windows={shown(windows)}: give shares of the frames, above 0, the last one 1, such as [0.25,1]")
    return config, list(named_today(others))


def _names(config: DictConfig) -> list[str]:
    """What is fitted, each name once."""
    names: list[str] = []
    for name in plain(config.parameters):
        if str(name) not in (*KINDS, *_SEVERAL):
            raise ConfigError(unknown("parameter", str(name), [*KINDS, *_SEVERAL]))
        names += [one for one in _SEVERAL.get(str(name), [str(name)]) if one not in names]
    if not names:
        raise ConfigError("parameters=[]: nothing is fitted; give some, such as parameters=[fabric]")
    return names


def _unknowns(config: DictConfig, settings: RolloutSettings, names: Sequence[str]) -> list[Unknown]:
    tables = {key: _table(config, key, names) for key in ("guess", "bounds", "priors")}
    found = []
    for name in names:
        kind = KINDS[name]
        lower, upper = _pair("bounds", name, tables["bounds"].get(name, [kind.lower, kind.upper]))
        if not lower < upper or (kind.log and lower <= 0):
            raise ConfigError(f"bounds: {name} is [{lower:g},{upper:g}]; give the least value, then the greatest"
                              + (", both above 0" if kind.log else ""))  # fmt: skip
        guess = tables["guess"].get(name, _value(settings, name))
        if isinstance(guess, bool) or not isinstance(guess, (int, float)):
            raise ConfigError(f"guess: {name} is {shown(guess)}; give a number from {lower:g} to {upper:g}")
        if not lower <= guess <= upper:
            raise ConfigError(f"guess: {name} is {guess:g}, outside its bounds {lower:g} to {upper:g}; give guess or bounds")
        prior = _pair("priors", name, tables["priors"][name]) if name in tables["priors"] else None
        if prior is not None and (prior[1] <= 0 or (kind.log and prior[0] <= 0)):
            raise ConfigError(f"priors: {name} is {shown(list(prior))}; give its value and a standard deviation above 0")
        found.append(Unknown(name, float(guess), lower, upper, kind.log, prior))
    return found


def _table(config: DictConfig, key: str, names: Sequence[str]) -> dict[str, Any]:
    table = {} if config[key] is None else plain(config[key])
    if not isinstance(table, dict):
        raise ConfigError(f"{key}={shown(table)}: give names and values in braces, see hood fit --help")
    strange = next((str(name) for name in table if name not in names), None)
    if strange is not None:
        raise ConfigError(f"{key}: {unknown('parameter', strange, names)}; parameters= says what is fitted")
    return table


def _pair(key: str, name: str, value: Any) -> tuple[float, float]:
    numbers = isinstance(value, list) and len(value) == 2
    if not numbers or not all(isinstance(one, (int, float)) and math.isfinite(one) for one in value):
        raise ConfigError(f"{key}: {name} is {shown(value)}; give two numbers, such as {key}={{{name}:[1,2]}}")
    return float(value[0]), float(value[1])


def _value(settings: RolloutSettings, name: str) -> Any:
    """What the keys of the rollout say of a parameter."""
    kind = KINDS[name]
    if kind.key == "wind":
        return _wind(settings)["xyz".index(name[-1])]
    value = OmegaConf.select(OmegaConf.create(dict(settings)), kind.key, default=None)
    if value is None:
        raise ConfigError(
            f"parameters: {name} is no number of this fabric, which is told in a laboratory's units; fit material=default"
        )
    return plain(value)


def _wind(settings: RolloutSettings) -> list[float]:
    """[m/s] along x, y and z; still air where there is none, or where that is left to the fabric."""
    wind = plain(settings.wind)
    if isinstance(wind, list):
        return wind
    return [0.0, 0.0, 0.0 if wind is None or isinstance(wind, str) else -float(wind)]


def _words(values: Mapping[str, float], settings: RolloutSettings) -> list[str]:
    """The keys of ``hood rollout`` with these values; what of the wind is not fitted is that of the settings."""
    keys: dict[str, Any] = {KINDS[name].key: value for name, value in values.items() if KINDS[name].key != "wind"}
    if any(KINDS[name].key == "wind" for name in values):
        keys["wind"] = [values.get(name, usual) for name, usual in zip(_SEVERAL["wind"], _wind(settings), strict=True)]
    return overrides(keys)


def _across(points: np.ndarray) -> float:
    """[m], twice the median distance from the middle: points of other things far away change little of it."""
    points = points[np.isfinite(points).all(axis=1)]
    return float(2.0 * np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


class _Scene:
    """The simulation of values, and how far it lies from what was seen."""

    def __init__(self, settings: RolloutSettings, observed: Observed, first: int, every: int, from_first: bool) -> None:
        self.settings, self.observed, self._first, self._every = settings, observed, first, every
        self.from_first = from_first and first == 0 and not observed.points and len(observed.frames) > 1
        self.ready: Any = None  # Setup, once checked

    def check(self, values: Mapping[str, float]) -> None:
        """Raise ConfigError where the frames that were seen are not those of the scene."""
        with heard():
            self.ready = self._set_up(values)
        scene, settles = self.ready.scene, start_of(self.ready.config)[0] == "equilibrium"
        settles = settles and own_start(self.ready.stepper, scene) is None
        self.from_first = self.from_first and settles and bool(np.isfinite(self.observed.frames[0]).all())
        last = self._first + self._every * (len(self.observed.frames) - 1)
        if last >= scene.num_frames:
            raise ConfigError(
                f"observed: its last frame is frame {last} of the simulation, but {scene.motion.name} has {scene.num_frames} "
                "frames; give num_frames, first or every, or a longer motion"
            )
        seen, worn = _across(self.observed.frames[0]), _across(scene.cloth.rest_pos.cpu().numpy())
        if not 0.05 < seen / worn < 20.0 and len(self.observed.frames[0]) > 2:
            raise ConfigError(f"observed: frame 0 is {seen / worn:.3g} times as large as the garment; give points in metres")
        if not self.observed.points:
            count = len(self.observed.frames[0])
            if count != scene.cloth.num_vertices:
                raise ConfigError(
                    f"observed: {count} vertices a frame, the garment has {scene.cloth.num_vertices}; give the garment that "
                    "was seen, or points=true where points belong to no vertices"
                )

    def _set_up(self, values: Mapping[str, float]) -> Setup:
        words = _words(values, self.settings)
        words += [f"losses.terms.air.velocity={word.partition('=')[2]}" for word in words if word.startswith("wind=")]
        for term in ("stretch_damping", "bend_damping"):
            words += [f"losses.terms.{term}.time={word.partition('=')[2]}" for word in words if word.startswith("damping=")]
        settings = self.settings.with_words(words)
        with nullcontext() if self.ready is None else unheard():  # what is said of the scene is said once
            return set_up(settings, make_stepper(settings)[0], tell=lambda sentence: None)

    def frames(self, values: Mapping[str, float], count: int) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """The number among the observed frames, cloth (V, 3) and body (W, 3) [m] of each of the first ``count``."""
        ready = self.ready = self._set_up(values)
        settle, relaxing = start_of(ready.config)
        total, start, solved = self._first + self._every * (count - 1) + 1, None, (ready.scene, ready.potential)
        if self.from_first:
            start = relaxed_from(self.observed.frames[0], *solved, ready.stepper.gravity)
        steps = simulate(ready.stepper, *solved, total, relaxing, metrics="none", settle=settle, start=start)
        for frame in steps:
            number, rest = divmod(frame.index - self._first, self._every)
            if number >= 0 and rest == 0:
                yield number, frame.world_pos.numpy(), frame.body_pos.numpy()

    def residual(self, values: Mapping[str, float], count: int) -> np.ndarray:
        """(N, 3) m, simulated less observed; NaN where these values cannot be simulated."""
        parts = []
        with heard(aloud=False):
            try:
                for number, cloth, _ in self.frames(values, count):
                    if not np.isfinite(cloth).all():
                        return np.full((1, 3), np.nan)
                    if number == 0 and self.from_first:
                        continue
                    parts.append(self.observed.apart(number, cloth, self.ready.scene.garment.faces))
            except ConfigError:
                raise
            except ValueError:  # of a size that nobody can wear, say
                return np.full((1, 3), np.nan)
        return np.concatenate(parts)


class _Fit:
    """One search with its files."""

    def __init__(self, config: DictConfig, scene: _Scene, unknowns: list[Unknown], words: list[str], folder: Path) -> None:
        self._config, self._scene, self._unknowns, self._words, self._folder = config, scene, unknowns, words, folder
        self._history: list[tuple[float, float]] = []  # share of the frames and rms

    def run(self) -> Fitted:
        now, count, interrupted, total = None, 0, False, len(self._scene.observed.frames)
        counts = [max(min(2, total), math.ceil(share * total)) for share in plain(self._config.windows)]
        try:
            for count in dict.fromkeys(counts):
                for now in self._window(count):
                    self._write(self._content(now, count))
        except KeyboardInterrupt:
            if now is None:
                raise
            interrupted = True
        assert now is not None
        content = self._content(now, count) | {"interrupted": interrupted}
        content["converged"] = content["converged"] and not interrupted
        self._write(content)
        for sentence in content["said"]:
            say(sentence)
        if interrupted:
            say(f"hood: interrupted; the best values so far are kept in {self._folder / 'fit.json'}", error=True)
        else:
            self._draw(now)
        say(f"simulate it: {content['command']}")
        say(f"files in {self._folder}: {', '.join(sorted(path.name for path in self._folder.iterdir()))}")
        return Fitted(content, self._folder, interrupted)

    def _window(self, count: int) -> Iterator[Minimum]:
        """The search in the first ``count`` frames; the next one begins where it ends."""
        noise, last = self._config.noise, count == len(self._scene.observed.frames)
        residual = partial(self._scene.residual, count=count)
        observed, most = self._scene.observed, int(self._config.most_steps)
        groups = observed.groups(int(self._scene.from_first), count, self._scene.ready.scene.cloth.num_vertices)
        steps = fit_steps(residual, self._unknowns, noise, _LEAST_NOISE, most, 1 if observed.points else 3, last, groups)
        for step, now in enumerate(steps):
            if now.covariance is None:
                self._history.append((count / len(self._scene.observed.frames), now.rms))
                values = ", ".join(f"{name} {value:.4g}" for name, value in now.values.items())
                say(f"{count} frames, step {step}: {1e3 * now.rms:.3f} mm apart; {values}")
            elif self._scene.from_first:
                now = replace(now, covariance=_MEASURED_START * now.covariance)
            yield now
        self._unknowns = [replace(one, guess=now.values[one.name]) for one in self._unknowns]

    def _content(self, now: Minimum, count: int) -> dict[str, Any]:
        """What ``fit.json`` holds."""
        found = {one.name: {"value": now.values[one.name], "unit": KINDS[one.name].unit} for one in self._unknowns}
        said, brief = list[str](), {name: float(f"{value:.6g}") for name, value in now.values.items()}
        if now.covariance is not None:
            told = estimates(now, self._unknowns)
            ratios = seen_ratios(now, self._unknowns, told)
            for name, estimate in told.items():
                found[name] |= asdict(estimate)
                said.append(_sentence(name, estimate, KINDS[name].unit))
            said += [
                f"only the ratio of {one} and {other} is seen, to {100 * share:.2g}%: what scales both changes nothing here"
                for (one, other), share in ratios.items()
            ]
            if not now.converged:
                said.append(
                    "not converged: these are the best values so far; give another guess, tighter bounds or more most_steps"
                )
        return {
            "parameters": found,
            "said": said,
            "converged": now.converged and count == len(self._scene.observed.frames),
            "interrupted": False,
            "rms": now.rms,
            "frames": count,
            "history": [{"share": share, "rms": rms} for share, rms in self._history],
            "observed": str(self._config.observed),
            "command": " ".join(["hood rollout", *self._words, *_words(brief, self._scene.settings)]),
        }

    def _write(self, content: dict[str, Any]) -> None:
        write_atomically(self._folder / "fit.json", json.dumps(content, indent=1).encode())

    def _draw(self, now: Minimum) -> None:
        """The loss over the steps, and what was found beside what was seen, where the picture libraries are installed."""
        try:
            from hood.media.bars import write_course
            from hood.media.beside import Panel, SideBySide
            from hood.media.video import save_png

            write_course([1e3 * rms for _, rms in self._history], "mm from what was seen", "step", self._folder / "loss.png")
            with heard(aloud=False):
                frames = [*self._scene.frames(now.values, len(self._scene.observed.frames))]
                fitted = _data(self._scene.ready, frames)
            seen = self._scene.observed.drawn(fitted)
            panels = [Panel(seen, "observed"), Panel(fitted, f"fitted, {1e3 * now.rms:.2f} mm apart")]
            save_png(self._folder / "beside.png", SideBySide(panels, width=300, height=420).sheet(_SHEET))
        except ImportError as error:
            say(f"no pictures: {error}", error=True)


def _sentence(name: str, found: Any, unit: str) -> str:
    unit = f" {unit}" if unit else ""
    if not found.seen:
        return f"{name}: not seen in this motion; anything from {found.low:.3g} to {found.high:.3g}{unit} fits as well"
    end = ", at its bound" if found.at_bound else ""
    return f"{name}: {found.value:.4g}{unit} (95%: {found.low:.5g} to {found.high:.5g}{end})"


def _data(ready: Setup, frames: Sequence[tuple[int, np.ndarray, np.ndarray]]) -> RolloutData:
    scene = ready.scene
    return RolloutData(
        np.stack([cloth for _, cloth, _ in frames]),
        scene.garment.faces,
        scene.cloth.rest_pos.cpu().numpy(),
        np.stack([body for _, _, body in frames]),
        np.asarray(scene.motion.faces),
        scene.dt * np.arange(len(frames)),
        {},
        {"garment": scene.garment.name},
        still=still_of(scene.garment, cloth=scene.cloth),
    )
