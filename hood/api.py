"""The library from Python: simulations, rollouts and training with the keys of the commands.

Every name here is also a name of the package: ``hood.simulate(…)``.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor
from tqdm import tqdm

from hood.app.common import load_stepper
from hood.app.notices import Bar, Item, collected, tell_how_far
from hood.app.output.frames import at_output_fps, finer_mesh, on_finer_mesh, output_rate
from hood.app.plan_file import plan_accuracy, plan_mode, plan_path, planned, rollout_config
from hood.app.scene.motion import NAMED, Own
from hood.app.settings.compose import ConfigError
from hood.app.settings.rollout_settings import measurement, overrides
from hood.app.setup import Setup, check_config, make_stepper, set_up, start_of
from hood.app.stepping.cautions import idle_in_rollout
from hood.app.stepping.guarding import GuardStopped, make_guard
from hood.assets.body.body import Body
from hood.assets.files.library import locate
from hood.assets.garment.garment import Garment, checked_garment
from hood.assets.material import NO_GRADIENT, Material
from hood.assets.motion.animated_mesh import BodyMesh
from hood.assets.motion.sequence import PoseSequence, checked_sequence
from hood.cloth.cloth import with_values
from hood.cloth.state import State
from hood.energies.potential import Potential
from hood.rollouts import loop as frames
from hood.rollouts.differentiable import precision_of
from hood.rollouts.frame import Frame
from hood.rollouts.gradients import DifferentiableFrames, constants_of, followed_stepper, restarts
from hood.scene.scene import Scene
from hood.steppers.network import NetworkStepper
from hood.steppers.newton import Stepper, require_stepper
from hood.tensors.batch import to_device


class Simulation:
    """A garment on a moving body, put together and ready to run; made by :func:`simulate`.

    Iterating yields :class:`hood.rollouts.frame.Frame` objects, frame 0 first. A second iteration simulates again.
    With ``guard="strict"``, :class:`hood.app.stepping.guarding.GuardStopped` is raised before the first frame that cannot be
    trusted.

    Attributes:
        scene: the cloth, the body and its motion (:class:`hood.scene.scene.Scene`).
        stepper: what takes the steps, refinement included (:class:`hood.steppers.newton.Stepper`).
        potential: the energies that it moves by (:class:`hood.Potential`).
        num_frames: how many frames there will be: no more than the motion has, and with ``output_fps`` those at that rate.
        faces: (F, 3) of the frames' ``world_pos``: those of the garment, or with ``refine_mesh`` of the finer mesh.
        notes: what was chosen and why, one sentence each (kernels, refinement, start).
    """

    def __init__(self, ready: Setup, notes: list[str], progress: bool = False) -> None:
        self._ready = ready
        self._progress = progress
        self.scene: Scene = ready.scene
        self.stepper: Stepper = ready.stepper
        self.potential: Potential = ready.potential
        self._simulated = min(int(ready.config.num_frames), ready.scene.num_frames)
        rate = output_rate(ready.config)
        self._finer = finer_mesh(ready.config, ready.scene)
        self.faces: np.ndarray = ready.scene.garment.faces if self._finer is None else self._finer.faces
        self.num_frames = self._simulated if rate is None else rate.count(self._simulated)
        self.notes = notes

    def __len__(self) -> int:
        return self.num_frames

    def start(self) -> State:
        """The state of frame 0, on the body, where :func:`hood.step` may begin. It is found anew, which takes a few steps."""
        return next(iter(self)).state

    @property
    def relaxes(self) -> bool:
        """Whether a network that restarts from a relaxing step begins with one."""
        return start_of(self._ready.config)[1] > 0

    def __iter__(self) -> Iterator[Frame]:
        config = self._ready.config
        with collected() as told:
            guard = make_guard(config, self.stepper, self.potential)
        self.notes += [line for line in told if line not in self.notes]
        measured, (settle, relaxing) = measurement(config), start_of(config)
        steps = frames.simulate(
            self.stepper,
            self.scene,
            self.potential,
            self._simulated,
            relaxing,
            metrics=measured.kind,
            fields=measured.fields,
            surface_stride=measured.surface_every,
            settle=settle,
            guard=guard,
            afresh=plan_mode(config) == "full",
        )
        seen = _bar(self._progress)(steps, self._simulated, "simulation")
        yield from on_finer_mesh(
            at_output_fps(seen, config, self.scene, self._simulated, self._ready.own), self._finer, self.scene
        )
        if guard is not None and guard.stopped is not None:
            raise GuardStopped(f"guard=strict: the simulation ends before frame {guard.stopped.frame}, which cannot be trusted")


def simulate(
    garment: str | Path | Garment | list[str] | list[Garment] | list[str | Garment] = "dress",
    sequence: str | Path | PoseSequence | BodyMesh = "walk_proud",
    *,
    body: str | Path | Body | BodyMesh = "default",
    material: str | Material | Mapping[str, Any] | None = None,
    stepper: str | Stepper = "auto",
    progress: bool = False,
    **keys: Any,
) -> Simulation:
    """Dress a moving body. Nothing is written to disk; frames come one by one as they are computed.

    Args:
        garment: a name, a file or a :class:`hood.Garment`, or a list of these for an outfit.
        sequence: a name or a file of a motion, or a :class:`hood.PoseSequence`.
        body: a name, a file or a :class:`hood.Body`, or a :class:`hood.BodyMesh`, which performs its own motion.
        material: a name (``denim``), a :class:`hood.Material`, or a dictionary of properties. None: the default fabric.
        stepper: ``network``, ``newton``, ``refine``, another option of ``hood rollout``, or an own stepper. ``auto``: the
            network where ``checkpoint``, ``refine`` or another key of it is given; else ``newton`` on a CPU, and on a GPU the
            faster of the two that is as accurate.
        progress: whether a progress bar is shown.
        keys: all keys of ``hood rollout --help`` that concern the simulation: ``checkpoint``, ``num_frames``,
            ``fps`` and ``output_fps`` [1/s], ``betas``, ``refine``, ``device``, … A dictionary stands for a group:
            ``solver={"target_rg": 1e-3}``.

    Returns:
        The :class:`Simulation`. A frame's ``world_pos`` is (V, 3) m, its ``body_pos`` (W, 3) m, both float64.

    Raises:
        ValueError: an unknown key or value, or a file that cannot be used. Names the key or the file.
        FileNotFoundError: an unknown name.

    Examples:
        >>> import hood
        >>> for frame in hood.simulate("tank", "walk_proud", num_frames=3):
        ...     print(frame.index, tuple(frame.world_pos.shape))
        0 (1016, 3)
        1 (1016, 3)
        2 (1016, 3)
    """
    own, named = _own(garment, body, sequence, material)
    named |= keys
    if stepper is None or isinstance(stepper, str):
        named["stepper"] = stepper
    else:
        require_stepper(stepper)
        for name, value in constants_of(getattr(stepper, "potential", None)).items():
            if getattr(value, "requires_grad", False):
                raise ConfigError(f"stepper: {name}: {NO_GRADIENT}")
        named["stepper"] = "network"  # what may be said of a network's steps may be said of these
    plans = plan_path(named) is not None or plan_accuracy(named) is not None
    key = "accuracy" if named.get("accuracy") is not None else "plan" if plans else None
    if key is not None and (own != NAMED or not isinstance(stepper, str)):
        raise ConfigError(f"{key}={named[key]}: a plan names garment, body, sequence, material and stepper; leave them out")
    if plan_path(named) is not None:  # then what is not said is the plan's
        usual = {key: parameter.default for key, parameter in inspect.signature(simulate).parameters.items()}
        named = {key: value for key, value in named.items() if usual.get(key) != value}
    notes: list[str] = []
    with collected() as told:  # choices are told to whoever reads the notes
        config = rollout_config(planned(overrides(named)))
        check_config(config)
        notes += idle_in_rollout(overrides(named), config)
        taken = make_stepper(config)[0] if isinstance(stepper, str) else stepper
        ready = set_up(config, taken, own, tell=notes.append)
    return Simulation(ready, [*told, *notes], progress)


def differentiable(
    simulation: Simulation,
    num_frames: int | None = None,
    gravity: Tensor | None = None,
    potential: Potential | None = None,
    rest_pos: Tensor | None = None,
    flat: Tensor | None = None,
    *,
    start: State | None = None,
    window: int | None = None,
    **fabric: Tensor | float,
) -> DifferentiableFrames:
    """States of the frames 1, 2, … of a simulation, as functions that torch differentiates.

    By the solver every step ends at the minimum of one known potential, so that its derivative is exact (implicit function
    theorem): contact, friction, layers of cloth and air included, to the accuracy that ``solver.target_rg`` asks for. By a
    network it is the network's own, of everything that it is told. What is nearest to what is constant, and so is frame 0 if it
    is not given. Memory grows by the states and contacts of the frames. The solver computes in float64, a network in float32,
    or in float64 where a tensor of that is given.

    Args:
        simulation: by ``stepper="newton"`` or ``"network"``; steps that are refined to an unbalanced force, as by
            ``refine="0.01rg"``, are taken by the solver, as far.
        num_frames: including frame 0; default those of the simulation.
        gravity: (3,) m/s².
        potential: with constants that are tensors; default that of the simulation.
        rest_pos, flat: (V, 3) and (F, 2, 2) m, the rest shape; see :func:`hood.cloth.cloth.with_values`.
        start: frame 0, whose positions and velocities may be differentiated; default ``simulation.start()``.
        window: gradients go back through at most so many steps: the state at every so many frames is a constant to the frames
            after it. Default: through all.
        fabric: ``lame_mu``, ``density``, …: one number or as many as there are faces, hinges (``bending_stiffness``) or
            vertices (``friction``).

    Returns:
        An iterator of :class:`hood.cloth.state.State`; where the cloth is in the world, (V, 3) m, is ``state.origin +
        state.pos``. Its :meth:`hood.rollouts.gradients.DifferentiableFrames.gradients` says how exact gradients are.

    Raises:
        ValueError: a stepper whose steps have no known derivative, or a value that does not fit.

    Examples:
        >>> import hood, torch
        >>> mu = torch.tensor(23600.0, dtype=torch.float64, requires_grad=True)
        >>> simulation = hood.simulate("tank", "plie", num_frames=3, stepper="newton")
        >>> *_, last = hood.differentiable(simulation, lame_mu=mu)
        >>> last.pos[:, 1].mean().backward()
        >>> bool(mu.grad > 0)  # harder cloth hangs higher
        True
    """
    most, shown = simulation._simulated, potential or simulation.potential
    given = {"gravity": gravity, "rest_pos": rest_pos, "flat": flat, **fabric, **constants_of(shown)}
    given |= {} if start is None else {"start.pos": start.pos, "start.vel": start.vel}
    stepper = followed_stepper(simulation, potential, given)
    cloth = with_values(to_device(simulation.scene.cloth, dtype=precision_of(stepper)), rest_pos, flat, **fabric)
    tensors = {name: value for name, value in given.items() if isinstance(value, Tensor)}
    state, steps = start or simulation.start(), (most if num_frames is None else min(num_frames, most)) - 1
    how = window, restarts(simulation, stepper), shown
    return DifferentiableFrames(stepper, simulation.scene, state, steps, cloth, gravity, tensors, *how)


def _own(garment: Any, body: Any, sequence: Any, material: Any) -> tuple[Own, dict[str, Any]]:
    """What :func:`simulate` is given as objects, checked, and the keys of what it is given by name."""
    named, own = {"garment": garment, "sequence": sequence} | ({} if body == "default" else {"body": body}), NAMED
    if isinstance(sequence, BodyMesh):
        if body != "default":
            raise ConfigError("sequence: a hood.BodyMesh is body and motion in one; leave body or sequence out")
        body, sequence = sequence, "walk_proud"
        named |= {"body": body, "sequence": sequence}
    if isinstance(garment, Garment) or (isinstance(garment, list) and any(isinstance(one, Garment) for one in garment)):
        own = replace(own, garment=_garments(garment))
        del named["garment"]
    if isinstance(body, Body | BodyMesh):
        own = replace(own, body=body)
        del named["body"]
        if isinstance(body, BodyMesh) and sequence != "walk_proud":
            raise ConfigError("sequence: body is a hood.BodyMesh, which performs its own motion; leave sequence out")
    if isinstance(sequence, PoseSequence):
        own = replace(own, sequence=checked_sequence(sequence))
        del named["sequence"]
    if isinstance(material, (str, Mapping)):
        named["material"] = material
    elif isinstance(material, Material):
        own = replace(own, material=material)
    elif material is not None:
        raise ConfigError(f"material is of type {type(material).__name__}; give a name, such as denim, or a hood.Material")
    return own, named


def _garments(given: Garment | list[Any]) -> Garment | list[Garment | str]:
    """A garment of arrays, or an outfit with some, checked."""
    if isinstance(given, Garment):
        return checked_garment(given)
    for place, one in enumerate(given):
        if not isinstance(one, (Garment, str, Path)):
            raise ConfigError(f"garment[{place}] is of type {type(one).__name__}; give a name, a file or a hood.Garment")
    return [checked_garment(one) if isinstance(one, Garment) else str(one) for one in given]


class Summary(dict[str, Any]):
    """What ``summary.json`` of a rollout holds. ``notes``: what ``hood rollout`` prints, a line each."""

    def __init__(self, content: Mapping[str, Any], notes: list[str]) -> None:
        super().__init__(content)
        self.notes = notes


def rollout(*, tell: Callable[[str], None] | None = None, progress: bool = False, **keys: Any) -> Summary:
    """Run ``hood rollout`` with its keys: files in ``output``, and the summary as a dictionary. Nothing is printed.

    Args:
        tell: is called with every line that the command prints, and every few seconds with how far the work is:
            ``tell=print``.
        progress: whether a progress bar is shown.
        keys: those of ``hood rollout --help``, such as ``garment="dress", num_frames=60, output="outputs/dress"``.

    Returns:
        What ``summary.json`` holds. ``summary["sound"]`` is False where the cloth cannot be trusted; ``summary.notes`` has the
        lines, warnings among them.

    Raises:
        ValueError, OSError: keys or files that cannot be used.
        KeyboardInterrupt: it was interrupted; the frames done are kept.

    Examples:
        >>> import hood
        >>> summary = hood.rollout(garment="tank", num_frames=3, video="none", output="outputs/tank", tell=print)
        stepper=newton: the solver, the default on a CPU; ...
        tank: 3 frames, all finite
        ...
        >>> summary["num_frames"]
        3
        >>> summary.notes[-1]
        'files in outputs/tank: config.yaml, contact_sheet.png, rollout.h5, summary.json, versions.json'
    """
    from hood.app.rollout import rollout as simulated

    with collected(tell):
        done = simulated(overrides(keys), _bar(progress))
    if done.interrupted:
        raise KeyboardInterrupt
    return Summary(json.loads((done.folder / "summary.json").read_text(encoding="utf-8")), done.notes)


def export(rollout: str | Path, *, tell: Callable[[str], None] | None = None, **keys: Any) -> Path:
    """Run ``hood export``: a rollout as a file that other programs open. Nothing is printed.

    Args:
        rollout: its ``rollout.h5``, or the folder of it.
        tell: is called with every line that the command prints: ``tell=print``.
        keys: those of ``hood export --help``, such as ``format="usd", output="dance.usd"``. Positions are written in metres.

    Returns:
        The file, or the folder of a format of many files.

    Raises:
        ValueError, OSError: keys or files that cannot be used.

    Examples:
        >>> import hood
        >>> _ = hood.rollout(garment="tank", num_frames=3, video="none", output="outputs/tank")
        >>> hood.export("outputs/tank", format="glb", tell=print).name
        outputs/tank/rollout.glb: ...
        'rollout.glb'
    """
    from hood.app.output.export import export as write

    with collected(tell):
        target, said = write([str(Path(rollout)), *overrides(keys)])
    if tell is not None:
        for line in said:
            tell(line)
    return target


def dress(*, tell: Callable[[str], None] | None = None, **keys: Any) -> dict[str, dict[str, Any]]:
    """Run ``hood dress`` with its keys: a data set of many rollouts in ``output``. Nothing is printed.

    Args:
        tell: is called with every line that the command prints: ``tell=print``.
        keys: those of ``hood dress --help`` and ``hood rollout --help``, such as ``garments=["dress"], motions=["plie"]``.

    Returns:
        The lines of ``manifest.jsonl`` by the names of their rows; ``verdict`` is ``failed`` where there is no rollout. A
        :class:`hood.RolloutDataset` of ``output`` reads the frames.

    Raises:
        ValueError, OSError: keys, files or a folder that cannot be used. A row that fails raises nothing.
        KeyboardInterrupt: it was interrupted; the same call goes on.

    Examples:
        >>> import hood
        >>> lines = hood.dress(garments=["tank"], motions=["plie"], num_frames=2, stepper="newton", output="outputs/few")
        >>> lines["tank/default/default/plie"]["verdict"]
        'sound'
    """
    from hood.app.batch.dress import dress_rows

    with collected(tell):
        done = dress_rows(overrides(keys))
    if done.interrupted:
        raise KeyboardInterrupt
    return dict(done.lines)


def train(*, tell: Callable[[str], None] | None = None, **keys: Any) -> Path:
    """Run ``hood train`` with its keys. Nothing is printed.

    Args:
        tell: is called with every line that the command prints, and every few seconds with how far the training is:
            ``tell=print``.
        keys: those of ``hood train --help``, such as ``experiment="quickstart", output="runs/mine"``. A dictionary stands for a
            group: ``trainer={"iterations": 100}``.

    Returns:
        The file of the weights, ``model.safetensors`` in ``output``; give it to ``checkpoint=``.

    Raises:
        ValueError, OSError: keys or files that cannot be used.
        KeyboardInterrupt: it was interrupted; the checkpoint is kept and ``resume=True`` goes on.

    Examples:
        >>> import hood
        >>> small = {"iterations": 1, "kernels": "torch"}
        >>> weights = hood.train(model="small", trainer=small, output="runs/first", tell=print)
        432,579 parameters, 7 garments, 22 motions
        ...
        >>> weights.name
        'model.safetensors'
    """
    from hood.app.train import train as trained

    with collected(tell):
        done = trained(overrides(keys))
    if done.interrupted:
        raise KeyboardInterrupt
    return done.weights


def _bar(progress: bool) -> Bar:
    """What shows how far a loop is: a bar, or lines for who is told."""
    return _shown if progress else tell_how_far


def _shown(items: Iterable[Item], total: int, what: str) -> Iterable[Item]:
    shown: Iterable[Item] = tqdm(items, total=total, desc=what, unit="frame")
    return shown


def load_model(name: str | Path = "quickstart", fps: float = 30.0, device: str = "cpu") -> NetworkStepper:
    """A trained network with its rules of motion, ready to take steps.

    Args:
        name: embedded weights, a ``model.safetensors``, or published HOOD weights (``.pth``).
        fps: steps per second it will take; published weights know one rate only.
        device: ``cpu`` or ``cuda``.

    Raises:
        FileNotFoundError: unknown name or missing file.
        ValueError: not a model file, or a model of another frame rate.

    Examples:
        >>> import hood
        >>> hood.load_model("quickstart").network.latent_dim
        48
    """
    return load_stepper(locate("weights", name), fps).eval().to(device)
