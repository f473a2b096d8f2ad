"""The potential as every vertex sees it alone, by the compiled solver's energies (``hood/native/newton.cpp``)."""

from __future__ import annotations

import ctypes
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.cloth.state import Attachments
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem
from hood.native.build import BuildError
from hood.solver.compiled import newton
from hood.solver.compiled.newton import compiled_step
from hood.solver.compiled.system import CompiledScene
from hood.solver.compiled.tables import build_tables
from hood.solver.vertex.block_jacobi import STEPS, LocalTerms, LocalView
from hood.tensors.batch import made_of
from hood.tensors.conjugate_gradients import Steps

_POINTER = ctypes.c_void_p


class EngineTerms:
    """Views of one step's potential, as :class:`hood.solver.vertex.block_jacobi.LocalTerms` gives them, for positions in
    float32.

    Energies are float64 inside: views are nearer to the exact ones than those of the torch form in float32.
    """

    _looked_at: Tensor | None = None  # the positions whose matrix the engines hold

    def __init__(self, potential: Potential, problem: StepProblem) -> None:
        state, dt = problem.state, problem.vertex_dt.double()
        base = (state.pos.double() + dt * state.vel.double()).numpy()
        self._step = replace(compiled_step(potential, problem), base=base)
        self._engines = _engines_of(problem.cloth, problem.step.attachments)
        self._sizes = problem.cloth.scene_sizes
        self._enter()

    def _enter(self) -> None:
        for scene, own in enumerate(self._engines):
            own.enter(self._step, scene)

    def __call__(self, pos: Tensor) -> LocalView:
        """The view at positions (V, 3)."""
        pos = pos.contiguous()
        force, step = torch.zeros_like(pos), torch.zeros_like(pos)
        for own in self._engines:
            own.alone(pos.data_ptr(), force.data_ptr(), step.data_ptr())
        self._looked_at = pos
        return LocalView(force, step)

    def solve(self, pos: Tensor, force: Tensor, damping: Tensor, steps: Steps = STEPS) -> Tensor:
        """As :meth:`hood.solver.vertex.block_jacobi.LocalTerms.solve`."""
        if any(own.step is not self._step for own in self._engines):  # they have been at another step since
            self._enter()
            self._looked_at = None
        if self._looked_at is not pos:
            self(pos)
        force, damping, step = force.contiguous(), damping.contiguous(), torch.zeros_like(force)
        for own, size in zip(self._engines, self._sizes, strict=True):
            own.together(force.data_ptr(), damping.data_ptr(), steps(size), step.data_ptr())
        return step


def local_terms(potential: Potential, problem: StepProblem, compiled: bool = True) -> LocalTerms | EngineTerms:
    """Views of one step's potential: compiled if asked for and possible, else in torch."""
    if compiled and applies(potential, problem):
        try:
            return EngineTerms(potential, problem)
        except BuildError:
            pass
    return LocalTerms(potential, problem)


def applies(potential: Potential, problem: StepProblem) -> bool:
    """Whether the compiled views know the potential and the numbers of ``problem``."""
    pos = problem.state.pos
    return type(pos) is Tensor and pos.dtype == torch.float32 and newton.applies(potential, problem)


def _engines_of(cloth: Cloth, attachments: Attachments | None) -> list[CompiledScene]:
    """Engines of a cloth's scenes, apart from those that the solver moves; kept as long as the cloth's faces live."""
    now, made = (cloth.hinges, cloth.free, None if attachments is None else attachments.edges), made_of(cloth.faces)
    then, engines = made.get("engines", (None, None))
    if engines is None or not all(_same(a, b) for a, b in zip(now, then, strict=True)):
        engines = [CompiledScene(cloth, build_tables(cloth, attachments, scene)) for scene in range(cloth.num_scenes)]
        made["engines"] = now, engines
    return list(engines)


def _same(a: Tensor | None, b: Tensor | None) -> bool:
    return a is b or (a is not None and b is not None and np.array_equal(a.numpy(), b.numpy()))
