"""Cells of the stability map on a coarse dress, run in process: what the gate judges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from omegaconf import DictConfig, OmegaConf

from hood.app.common import weigh
from hood.app.notices import heard
from hood.app.settings.compose import load_config
from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.setup import make_scene, make_stepper
from hood.app.stepping.cloth_contact import potential_of
from hood.app.stepping.guarding import guard_sentence, make_guard
from hood.app.stepping.refinement import refined
from hood.model.kernels.block import check_kernels
from hood.rollouts.checks.guard import CUT
from hood.rollouts.file.reader import RolloutData
from hood.rollouts.frame import Frame
from hood.rollouts.loop import simulate
from hood.rollouts.verdict.rule import judge_rollout
from hood.scene.scene import Scene
from hood.steppers.newton import Stepper
from hood.studies.envelope.cells import Cell, cells
from hood.studies.envelope.extreme_files import write_garment, write_motion
from hood.studies.envelope.judge import SOUND, Criteria, Judged, JudgedRun, judge

FRAMES = 20
#: Steps of the solver's reference in one of its own.
FINER = 4
#: Motions of the map stand still for half a second; rollouts begin a third of a second in.
CALM_FRAMES = 10
METHODS = {
    "quickstart": ("checkpoint=quickstart", "refine=0"),
    "quickstart+5": ("checkpoint=quickstart", "refine=5"),
    "newton": ("stepper=newton",),
}
CRITERIA = Criteria(climb=np.inf)
#: Triangles of 5 cm on a body: the skin cuts 3% of them in a quiet dance and sticks out by 10 mm [m], which says nothing about
#: the method.
ORDINARY = {"skin_through_cloth": 0.06, "skin_depth": 0.015}

Metrics = Mapping[str, np.ndarray]


def chosen(names: list[str]) -> list[Cell]:
    """Cells of the map by name."""
    known = {cell.name: cell for cell in cells()}
    return [known[name] for name in names]


class Battery:
    """Runs cells; what they need as files is made once, in ``folder``."""

    def __init__(self, folder: Path) -> None:
        self._folder, self.dress = folder, folder / "dress.npz"
        write_garment(self.dress, "dress", "remesh:300")
        self._runs: dict[tuple[Cell, str, str, int], JudgedRun] = {}
        self._configs: dict[str, DictConfig] = {}
        self._network: Stepper | None = None

    def judged(self, cell: Cell, method: str, mode: str = "report") -> Judged:
        """The class of a cell. Strain of networks is held against the solver's in the same cell; that of the solver, where it
        is beyond the plain limit, against its own at a quarter of the time step, as in the map."""
        run = self.run(cell, method, mode)
        if method != "newton":
            return judge(cell, run, self.solved(cell), method == "quickstart", CRITERIA)
        alone = judge(cell, run, None, False, CRITERIA)
        return alone if alone.kind == SOUND else judge(cell, run, self.finer(cell), False, CRITERIA)

    def finer(self, cell: Cell) -> Metrics:
        """The solver's metrics in a cell at a quarter of the time step."""
        settings = tuple(text for text in cell.settings if not text.startswith("fps="))
        fine = replace(cell, settings=(*settings, f"fps={FINER * cell.fps:g}"))
        return self._metrics(fine, FINER)

    def solved(self, cell: Cell) -> Metrics:
        """The solver's metrics in a cell."""
        return self._metrics(cell)

    def _metrics(self, cell: Cell, finer: int = 1) -> Metrics:
        metrics = self.run(cell, "newton", "report", finer).metrics
        assert metrics is not None
        return metrics

    def run(self, cell: Cell, method: str, mode: str, finer: int = 1) -> JudgedRun:
        """A rollout of :meth:`_run`, made once."""
        key = (cell, method, mode, finer)
        if key not in self._runs:
            self._runs[key] = self._run(*key)
        return self._runs[key]

    def _run(self, cell: Cell, method: str, mode: str, finer: int) -> JudgedRun:
        """A rollout as of ``hood rollout``, of ``finer`` times as many frames, and what it says of itself.

        Two things that it says of every cell do not count: that networks were not trained on so coarse a dress, and how much
        the skin cuts.
        """
        config = self._config(cell, method, mode)
        with heard(aloud=False) as warned:
            scene = make_scene(config)
            potential = potential_of(config)
            stepper = refined(self._stepper(config, method), config, scene.cloth.num_vertices, potential)
            guard = make_guard(config, stepper, potential)
            start, count = finer * CALM_FRAMES if cell.motion is not None else 0, finer * (FRAMES - 1) + 1
            frames = list(simulate(stepper, scene, potential, count, settle="equilibrium", start_frame=start, guard=guard))
        names = {name for frame in frames for name in frame.metrics}
        metrics = {name: np.array([frame.metrics.get(name, np.nan) for frame in frames]) for name in names}
        finite = np.array([bool(np.isfinite(frame.world_pos.numpy()).all()) for frame in frames])
        verdict = judge_rollout(_stored(frames, scene, metrics))
        assert guard is not None
        told = guard_sentence(mode, [alarm for alarm in guard.alarms if alarm.cause != CUT], len(frames))
        counted = [
            reason for reason in verdict.reasons if reason.value is None or reason.value > ORDINARY.get(reason.kind, -1.0)
        ]
        unsound = tuple(reason.sentence for reason in counted) if verdict.sound is False else ()
        return JudgedRun(3 if unsound else 0, "", (*warned, *([told] if told else [])), unsound, {**metrics, "finite": finite})

    def _config(self, cell: Cell, method: str, mode: str) -> DictConfig:
        """Composed once a method: to do so takes longer than a rollout."""
        if method not in self._configs:
            self._configs[method] = load_config("rollout", [*METHODS[method], f"kernels={_kernels()}"])
        config = OmegaConf.merge(self._configs[method], OmegaConf.from_dotlist([*self._asked(cell), f"guard={mode}"]))
        assert isinstance(config, DictConfig)
        return config

    def _stepper(self, config: DictConfig, method: str) -> Stepper:
        """Weights are read once."""
        if method == "newton":
            return make_stepper(RolloutSettings.of(config))[0]
        self._network = self._network or make_stepper(RolloutSettings.of(config))[0]
        weigh(self._network, config)
        return self._network

    def _asked(self, cell: Cell) -> list[str]:
        garment, motion = self.dress, "dance_mixed"
        if cell.fault is not None:
            garment = self._folder / f"{cell.fault.replace(':', '_')}.npz"
            if not garment.exists():
                write_garment(garment, str(self.dress), cell.fault)
        if cell.motion is not None:
            path = self._folder / f"{cell.motion.replace(':', '_')}_motion.npz"
            if not path.exists():
                write_motion(path, cell.motion, 3.0)
            motion = str(path)
        return [f"garment={garment}", f"sequence={motion}", *cell.settings]


def _stored(frames: list[Frame], scene: Scene, metrics: Metrics) -> RolloutData:
    """The rollout as it would be read back."""
    return RolloutData(
        np.stack([frame.world_pos.numpy() for frame in frames]),
        scene.garment.faces,
        scene.cloth.rest_pos.numpy(),
        np.stack([frame.body_pos.numpy() for frame in frames]),
        scene.motion.faces,
        scene.dt * np.arange(len(frames)),
        dict(metrics),
        {"garment": scene.garment.name},
    )


def _kernels() -> str:
    """The same in every run on a machine, fast where there is a compiler."""
    try:
        check_kernels("fused", "fp32", 64)
    except ValueError:
        return "torch"
    return "fused"
