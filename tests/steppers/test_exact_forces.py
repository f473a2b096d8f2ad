"""Wind and damping against closed forms and ordinary differential equations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import integrate

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import State
from hood.energies.damping import BendDamping, StretchDamping
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.energies.wind import Wind
from hood.solver.newton import NewtonSettings
from hood.steppers.newton import implicit_euler
from hood.testing import grid, make_problem

F64 = torch.float64
G, AIR, PLATE = 9.81, 1.2, 1.17
SETTINGS = NewtonSettings(target_rg=1e-7)


def weighed(problem: StepProblem, gravity: float) -> StepProblem:
    return replace(problem, gravity=torch.tensor([0.0, -gravity, 0.0], dtype=F64))


def velocities(potential: Potential, problem: StepProblem, steps: int) -> np.ndarray:
    """Mean velocity of the cloth after every step, (T, 3)."""
    found = []
    for step in implicit_euler(potential, problem, steps, SETTINGS):
        assert step.report.converged.all(), step.report.reason
        found.append(step.state.vel.mean(dim=0).numpy())
    return np.array(found)


@pytest.mark.parametrize("rising", [0.0, 1.0])
def test_a_flat_sheet_falls_at_its_terminal_velocity(rising):
    """v(t) = v∞ tanh(g t / v∞) in still air; in air that rises it ends slower by as much."""
    density, dt = 0.2, 1 / 240
    terminal = np.sqrt(2.0 * density * G / (AIR * PLATE))
    cloth = build_cloth(*grid(6, 6, 0.3), Material(density=density), dtype=F64)
    potential = default_potential().with_terms(wind=Wind([0.0, rising, 0.0]))
    found = -velocities(potential, weighed(make_problem(cloth, dt=dt), G), 240)[:, 1]
    assert found[-1] == pytest.approx(terminal - rising, rel=1e-3)
    if not rising:
        time = dt * np.arange(1, 241)
        np.testing.assert_allclose(found, terminal * np.tanh(G * time / terminal), rtol=0, atol=0.02 * terminal)


def test_one_long_step_of_light_cloth_in_a_strong_wind_does_not_overshoot():
    """Explicit drag of this cloth would throw it back at several times the wind's speed."""
    cloth = build_cloth(*grid(5, 5, 0.3), Material(density=0.05), dtype=F64)
    problem = weighed(make_problem(cloth, dt=0.1), 0.0)
    found = velocities(default_potential().with_terms(wind=Wind([0.0, 12.0, 0.0])), problem, 8)[:, 1]
    assert (np.diff(found) > 0).all()
    assert 6.0 < found[0] < found[-1] < 12.0


def test_a_stiff_strip_swings_down_in_air_as_its_differential_equation_says():
    """A plate of length L that hangs by its edge: m L³/3 θ'' = -m g L²/2 sin θ - ½ ρ C L⁴/4 |θ'| θ'."""
    density, length, start, dt = 0.2, 0.3, 0.4, 1 / 1600
    rows = 13
    pos, faces = grid(rows, 2, length)
    pos = np.stack([0.1 * pos[:, 2], -np.cos(start) * pos[:, 0], np.sin(start) * pos[:, 0]], axis=1)
    material = Material(density=density, bending_stiffness=30.0, lame_mu=1e6, lame_lambda=0.0)
    cloth = build_cloth(pos, faces, material, np.arange(len(pos)) < 2, dtype=F64)
    potential = default_potential().with_terms(wind=Wind(friction=0.0))

    def slope(_, state):
        angle, speed = state
        air = 0.5 * AIR * PLATE * length**4 / 4.0 * abs(speed) * speed
        return speed, -(density * G * length**2 / 2.0 * np.sin(angle) + air) / (density * length**3 / 3.0)

    steps = 760  # past the far end of the first swing
    exact = integrate.solve_ivp(slope, (0.0, steps * dt), (start, 0.0), rtol=1e-9, atol=1e-12, dense_output=True)
    angles = []
    for step in implicit_euler(potential, weighed(make_problem(cloth, dt=dt), G), steps, SETTINGS):
        x = step.state.pos[-1]
        angles.append(float(torch.atan2(x[2], -x[1])))
    expected = exact.sol(dt * np.arange(1, steps + 1))[0]
    far_end = -expected.min()
    assert far_end < 0.75 * start  # the air has taken much of it
    assert -min(angles) == pytest.approx(far_end, rel=0.02)


def measured_mode(
    potential: Potential, problem: StepProblem, shape: np.ndarray, steps: int = 60, skipped: int = 0
) -> tuple[float, float]:
    """Angular frequency [1/s] and decay rate [1/s] of a small vibration of a shape (V, 3), after the ``skipped`` steps in which
    faster modes die.

    One mode obeys a(t+1) = p a(t) + q a(t-1), whatever its amplitude; -q is the decay over two steps.
    """
    dt, mass = float(problem.step.dt[0]), problem.cloth.mass.numpy()[:, None] * problem.cloth.free.numpy()[:, None]
    start = problem.state.pos
    moved = replace(problem, state=State(start + 1e-4 * torch.as_tensor(shape), 0 * start, problem.state.origin))
    settings = NewtonSettings(target_rg=1e-9, max_iterations=5)
    series = np.array(
        [
            float((mass * shape * (step.state.pos - start).numpy()).sum())
            for step in implicit_euler(potential, moved, steps, settings)
        ]
    )[skipped:]
    p, q = np.linalg.lstsq(np.stack([series[1:-1], series[:-2]], axis=1), series[2:], rcond=None)[0]
    root = np.roots([1.0, -p, -q]).astype(complex)[0]
    return abs(np.angle(root)) / dt, -np.log(abs(root)) / dt


def test_an_axial_vibration_of_a_strip_decays_at_half_its_time_times_its_frequency_squared():
    """A bar held at one end: ω = π c / 2L with c² = 2 μ h / ρ (λ = 0); the rate η ω² / 2 is that of a Kelvin-Voigt solid."""
    rows, length, material = 21, 0.5, Material(lame_lambda=0.0)
    omega = np.pi / (2.0 * length) * np.sqrt(2.0 * material.lame_mu * material.thickness / material.density)
    time = 0.2 / omega
    pos, faces = grid(rows, 3, length)
    cloth = build_cloth(pos * [1.0, 1.0, 0.1], faces, material, np.arange(3 * rows) < 3, dtype=F64)
    problem = weighed(make_problem(cloth, dt=0.005 * time), 0.0)
    shape = np.sin(np.pi * pos[:, :1] / (2.0 * length)) * [1.0, 0.0, 0.0]
    frequency, rate = measured_mode(default_potential().with_terms(damping=StretchDamping(time)), problem, shape)
    assert rate == pytest.approx(0.5 * time * omega**2, rel=0.02)
    assert np.hypot(frequency, rate) == pytest.approx(omega, rel=0.005)


def test_a_bending_vibration_decays_by_the_damping_of_bending():
    """A strip clamped at one end; what implicit Euler takes by itself is measured without damping and left out."""
    rows, length, material = 13, 0.3, Material(lame_lambda=0.0, bending_stiffness=1e-2)
    pos, faces = grid(rows, 2, length)
    pos = pos * [1.0, 1.0, 0.1]
    cloth = build_cloth(pos, faces, material, np.arange(len(pos)) < 4, dtype=F64)  # two rows: clamped
    x = 1.8751 * np.clip(pos[:, :1] - pos[2, 0], 0.0, None) / (length - pos[2, 0])
    shape = (np.cosh(x) - np.cos(x) - 0.7341 * (np.sinh(x) - np.sin(x))) * [0.0, 1.0, 0.0]  # a cantilever's
    time, problem = 0.05, weighed(make_problem(cloth, dt=5e-3), 0.0)
    omega, numerical = measured_mode(default_potential(), problem, shape, 400, 100)
    _, rate = measured_mode(default_potential().with_terms(damping=BendDamping(time)), problem, shape, 400, 100)
    assert rate > 5.0 * numerical
    assert rate - numerical == pytest.approx(0.5 * time * omega**2, rel=0.02)
