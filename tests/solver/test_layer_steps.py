"""Steps in which cloth meets cloth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from layer_scenes import folding_strip, sheet_over_bar, sheets_on_sphere, stack

from hood.cloth.cloth import concatenate_cloths
from hood.cloth.state import concatenate_states, concatenate_step_inputs
from hood.energies.contact import Collision
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.energies.self_contact import LayerBarrier, LayerFriction
from hood.mesh.penetration.crossing import self_crossings
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.vertex.gauss_seidel import sweep
from hood.steppers.newton import EulerStep, implicit_euler

pytestmark = pytest.mark.usefixtures("compiled_layers")

POTENTIAL = default_potential().with_terms(layers=LayerBarrier(), layer_friction=LayerFriction())
SMALL = {
    "folding_strip": lambda dt: folding_strip(dt, n=10),
    "sheet_over_bar": lambda dt: sheet_over_bar(dt, n=9),
    "sheets_on_sphere": lambda dt: sheets_on_sphere(dt, n=9),
    "stack": lambda dt: stack(dt, n=4, count=5),
}


#: Steps by their number in a second, 0.4 s of each scene.
RATES = {240: 96, 60: 24, 30: 12, 15: 6}


def _march_clean(
    problem: StepProblem, steps: int, settings: NewtonSettings | None = None, potential: Potential = POTENTIAL
) -> tuple[int, int]:
    """Pairs of features in reach, and steps that missed the accuracy; nothing may ever cross."""
    faces, touched, missed = problem.cloth.faces.numpy(), 0, 0
    for now in implicit_euler(potential, problem, steps, settings):
        pos = now.state.pos.numpy()
        layers = now.problem.layers[0].layers
        touched += len(layers.contacts(pos).corners)
        missed += not bool(now.report.converged.all())
        assert layers.crossed == layers.forced == 0
        assert len(self_crossings(pos, faces)) == 0
    return touched, missed


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("name", SMALL)
def test_clean_cloth_stays_clean(name: str, rate: int) -> None:
    touched, missed = _march_clean(SMALL[name](1 / rate), RATES[rate])
    assert missed == 0
    assert touched > 0 or name == "sheet_over_bar"


@pytest.mark.parametrize("name", ["folding_strip", "stack"])
def test_clean_cloth_stays_clean_in_torch(name: str) -> None:
    touched, missed = _march_clean(SMALL[name](1 / 30), 8, NewtonSettings(engine="torch"))
    assert missed == 0
    assert touched > 0


class OwnCollision(Collision):
    """Contact that somebody has written, whose slope alone the solver knows."""


def test_clean_cloth_stays_clean_on_a_body_with_contact_of_an_own_class() -> None:
    potential = POTENTIAL.with_terms(collision=OwnCollision())
    touched, _ = _march_clean(SMALL["stack"](1 / 30), 3, NewtonSettings(max_iterations=10), potential)
    assert touched > 0


@pytest.mark.slow
def test_a_long_strip_that_folds_at_full_speed_stays_clean() -> None:
    """2 m/s onto the floor, 7 cm a step: it crumples, and the way of all of it would end wherever two of its features meet."""
    touched, _ = _march_clean(folding_strip(1 / 30), 12)
    assert touched > 10000


@pytest.mark.parametrize("engine", ["compiled", "torch"])
def test_held_vertices_push_layers_before_them(engine: str) -> None:
    """A row of the upper sheet that is driven down by 12 mm a step takes the lower one along."""
    for now, crossed, short in _drive(_ROW, held=(0,), steps=(1, 2, 3, 4), engine=engine):
        assert crossed == short == now.problem.layers[0].layers.forced == 0


@pytest.mark.parametrize("engine", ["compiled", "torch"])
def test_held_vertices_that_meet_stop_short_and_go_on_when_there_is_room(engine: str) -> None:
    """The middle of both sheets is held. The upper one's should go down through the lower one and come back: both give way."""
    lags = []
    for now, crossed, short in _drive(_MIDDLE, held=(0, 1), steps=(1, 2, 2, 2, 1, 0, 0), engine=engine):
        pins, problem = now.problem.layers[0].pins, now.problem
        assert crossed == problem.layers[0].layers.forced == 0
        assert bool(now.report.converged.all())
        assert pins is not None
        assert short == pytest.approx(float(pins.lag.max()), abs=1e-12)
        # The places that they come to are the step's boundary condition, for every energy and for the solver.
        assert problem.step.pin_target is not None
        assert torch.equal(now.state.pos[problem.cloth.pinned], problem.step.pin_target[problem.cloth.pinned])
        lags.append(short)
    assert lags[1] > 7e-3
    assert abs(lags[3] - lags[2]) < 1e-3
    assert lags[-2:] == [0.0, 0.0]


def test_late_pins_are_those_of_each_scene_of_a_batch() -> None:
    held = _held_sheets(_MIDDLE, (0, 1))
    ways = [torch.zeros_like(held.state.pos) for _ in range(2)]
    for way, down in zip(ways, (-12e-3, -1e-3), strict=True):
        way[25:, 1] = down
    alone = [replace(held, step=replace(held.step, pin_target=held.state.pos + way)) for way in ways]
    together = POTENTIAL.prepare(_batch(alone)).step.pin_target
    singles = [POTENTIAL.prepare(problem).step.pin_target for problem in alone]
    assert together is not None
    for scene, (single, problem) in enumerate(zip(singles, alone, strict=True)):
        assert single is not None
        assert problem.step.pin_target is not None
        assert torch.equal(single, problem.step.pin_target) == (scene == 1)
        assert torch.equal(single, together[50 * scene : 50 * (scene + 1)])


#: Vertices of a sheet of 5 by 5 that are held.
_ROW, _MIDDLE = list(range(10, 15)), [6, 7, 8, 11, 12, 13, 16, 17, 18]


def _held_sheets(places: list[int], held: tuple[int, ...]) -> StepProblem:
    """Two sheets in the air, the upper (0) and the lower (1), with the same places held of some of them."""
    problem = stack(1 / 30, n=5, count=2)
    pinned = torch.zeros(50, dtype=torch.bool)
    for sheet in held:
        pinned[torch.tensor(places) + (25 if sheet == 0 else 0)] = True
    return replace(problem, cloth=replace(problem.cloth, pinned=pinned), step=replace(problem.step, obstacle=None))


def _batch(problems: list[StepProblem]) -> StepProblem:
    cloth = concatenate_cloths([problem.cloth for problem in problems])
    state = concatenate_states([problem.state for problem in problems])
    step = concatenate_step_inputs([problem.step for problem in problems], [len(problem.state.pos) for problem in problems])
    return StepProblem(cloth, state, step, gravity=problems[0].gravity)


def _drive(
    places: list[int], held: tuple[int, ...], steps: tuple[int, ...], engine: str
) -> Iterator[tuple[EulerStep, int, float]]:
    """Steps, pairs of faces that cross after each, and how far held vertices are short of where they should be: held places of
    the upper sheet as many times 12 mm down as ``steps`` say."""
    problem = _held_sheets(places, held)
    start, faces, rows = problem.state.pos, problem.cloth.faces.numpy(), problem.cloth.pinned
    down = torch.zeros_like(start)
    down[25:, 1] = -12e-3
    inputs = [replace(problem.step, pin_target=start + count * down) for count in steps]
    taken = implicit_euler(POTENTIAL, problem, len(steps), NewtonSettings(engine=engine), inputs.__getitem__)
    for now, step in zip(taken, inputs, strict=True):
        assert step.pin_target is not None
        short = float((now.state.pos - step.pin_target)[rows].norm(dim=1).max())
        yield now, len(self_crossings(now.state.pos.numpy(), faces)), short


def test_without_layers_the_same_sheets_cross() -> None:
    problem = SMALL["sheets_on_sphere"](1 / 30)
    *_, last = implicit_euler(default_potential(), problem, 12)
    assert len(self_crossings(last.state.pos.numpy(), problem.cloth.faces.numpy())) > 0


def test_compiled_and_torch_reach_the_same_minimum() -> None:
    *_, before = implicit_euler(POTENTIAL, SMALL["stack"](1 / 30), 4)
    problem = replace(before.problem, state=before.state, contact=None, layers=())
    ends = []
    for engine in ("compiled", "torch"):
        settings = NewtonSettings(target_rg=1e-6, engine=engine)
        pos, report = minimize(POTENTIAL, problem, settings=settings)
        assert bool(report.converged.all())
        ends.append((pos, float(report.phi)))
    assert ends[0][1] == pytest.approx(ends[1][1], rel=1e-9, abs=1e-12)
    torch.testing.assert_close(ends[0][0], ends[1][0], rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("engine", ["compiled", "torch"])
def test_cloth_that_meets_none_moves_to_the_bit_as_without(engine: str) -> None:
    problem = stack(1 / 30, n=5, count=1)
    settings = NewtonSettings(engine=engine)
    for one, other in zip(
        implicit_euler(POTENTIAL, problem, 3, settings), implicit_euler(default_potential(), problem, 3, settings), strict=True
    ):
        assert torch.equal(one.state.pos, other.state.pos)


def test_steps_do_not_depend_on_those_before() -> None:
    """What is known of where the last step ended spares a search and changes nothing, to the bit."""
    spared = touched = 0
    for now in implicit_euler(POTENTIAL, sheets_on_sphere(1 / 30, n=9, gap=0.05), 6):
        layers = now.problem.layers[0].layers
        spared += layers.mesh.apart is not None
        touched += len(layers.contacts(now.state.pos.numpy()).corners) > 0
        kept, layers.mesh.apart = layers.mesh.apart, None
        alone, _ = minimize(POTENTIAL, replace(now.problem, layers=()))
        assert torch.equal(alone, now.state.pos)
        layers.mesh.apart = kept
    assert spared > 1
    assert touched > 1


def test_report_is_that_of_the_potential() -> None:
    *_, before = implicit_euler(POTENTIAL, SMALL["stack"](1 / 30), 4)
    problem = POTENTIAL.prepare(replace(before.problem, state=before.state, contact=None, layers=()))
    pos, report = minimize(POTENTIAL, problem)
    assert float(report.phi) == pytest.approx(float(POTENTIAL.total(problem, pos)), rel=1e-9)
    assert float(POTENTIAL.energies(problem, pos)["layers"]) > 0


def test_sweeps_refuse_layers() -> None:
    with pytest.raises(ValueError, match="cross cloth"):
        sweep(POTENTIAL, SMALL["stack"](1 / 30), None, 1)
