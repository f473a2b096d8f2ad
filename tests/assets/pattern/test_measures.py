"""Measures of a body: on shapes whose girths are known, and on bodies that grow."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

from hood.assets.body.body import Body
from hood.assets.pattern.measures import Measures, cuts, girth, measure_body

UP = np.array([0.0, 1.0, 0.0])


def cylinder(radius: float, height: float, x: float = 0.0, sides: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """A closed prism of that many sides around the line above (x, 0)."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    ring = np.stack([x + radius * np.sin(angle), np.zeros(sides), radius * np.cos(angle)], axis=1)
    vertices = np.concatenate([ring, ring + height * UP, [[x, 0.0, 0.0], [x, height, 0.0]]])
    here, after = np.arange(sides), (np.arange(sides) + 1) % sides
    faces = [
        np.stack([here, after, here + sides], axis=1),
        np.stack([after, after + sides, here + sides], axis=1),
        np.stack([after, here, np.full(sides, 2 * sides)], axis=1),
        np.stack([here + sides, after + sides, np.full(sides, 2 * sides + 1)], axis=1),
    ]
    return vertices, np.concatenate(faces)


def measured(body: Body, beta: float = 0.0) -> Measures:
    vertices, joints = body.shaped(np.array([beta]))
    return measure_body(vertices, body.faces, joints)


@pytest.mark.parametrize("height", [0.3, 0.5, 0.777])
def test_a_tape_around_a_cylinder_is_its_girth(height: float) -> None:
    vertices, faces = cylinder(0.2, 1.0)
    (curve,) = cuts(vertices, faces, height * UP, UP)
    assert girth(curve, UP) == pytest.approx(2 * 60 * 0.2 * np.sin(np.pi / 60), rel=1e-12)


def test_a_plane_across_it_cuts_a_longer_curve() -> None:
    vertices, faces = cylinder(0.2, 1.0)
    normal = np.array([0.0, 1.0, 1.0])
    (curve,) = cuts(vertices, faces, 0.5 * UP, normal)
    angle = np.linspace(0.0, 2.0 * np.pi, 20001)
    ellipse = np.stack([0.2 * np.cos(angle), 0.2 * np.sqrt(2.0) * np.sin(angle)], axis=1)
    assert girth(curve, normal) == pytest.approx(np.linalg.norm(np.diff(ellipse, axis=0), axis=1).sum(), rel=2e-3)


def test_a_tape_is_taut_over_a_hollow() -> None:
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.5, 0.1], [0.0, 1.0]])
    curve = np.stack([square[:, 0], np.zeros(5), square[:, 1]], axis=1)
    assert girth(curve, UP) == pytest.approx(4.0)


def test_every_curve_is_found() -> None:
    (first, own), (second, other) = cylinder(0.1, 1.0, -0.3), cylinder(0.2, 1.0, 0.3)
    vertices, faces = np.concatenate([first, second]), np.concatenate([own, other + len(first)])
    curves = cuts(vertices, faces, 0.4 * UP, UP)
    girths = sorted(girth(curve, UP) for curve in curves)
    assert girths == pytest.approx([2 * 60 * radius * np.sin(np.pi / 60) for radius in (0.1, 0.2)])
    assert cuts(vertices, faces, 2.0 * UP, UP) == []


def test_measures_of_the_default_body(body: Body) -> None:
    m = measured(body)
    assert m.height == pytest.approx(1.72, abs=0.02)
    assert 0.0 < m.ankle_height < m.knee_height < m.crotch_height < m.hip_height < m.waist_height < m.underarm_height
    assert m.underarm_height < m.shoulder_height < m.neck_height < 0.9 * m.height
    assert m.wrist < m.upper_arm < m.neck < m.head < m.waist < m.chest
    assert m.ankle < m.knee < m.thigh < m.waist < m.hips
    # Of people: the crotch at 45%, the waist at 62% of the height, arms of a third.
    assert m.crotch_height / m.height == pytest.approx(0.45, abs=0.03)
    assert m.waist_height / m.height == pytest.approx(0.62, abs=0.03)
    assert m.arm_length / m.height == pytest.approx(0.31, abs=0.04)
    assert m.back < 0.0 < m.front


def test_measures_scale_with_the_body(body: Body) -> None:
    vertices, joints = body.shaped(np.zeros(1))
    plain, grown = (asdict(measure_body(s * vertices, body.faces, s * joints)) for s in (1.0, 1.1))
    for name, value in plain.items():
        assert np.allclose(grown[name], 1.1 * np.array(value), rtol=0.02, atol=2e-3), name


def test_measures_are_above_the_lowest_point(body: Body) -> None:
    vertices, joints = body.shaped(np.zeros(1))
    here, there = (asdict(measure_body(vertices + up * UP, body.faces, joints + up * UP)) for up in (0.0, 0.7))
    for name, value in here.items():
        assert np.allclose(there[name], value, atol=1e-6), name


def test_a_surface_without_a_body_in_it_is_refused(body: Body) -> None:
    vertices, joints = body.shaped(np.zeros(1))
    with pytest.raises(ValueError, match="the body cannot be measured: nothing of it is at"):
        measure_body(0.3 * vertices, body.faces, joints)
