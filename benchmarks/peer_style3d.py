"""Newton's solver Style3D: hood's fabric in its terms, and the solver on a CPU; the rest is in ``peer_newton.py``.

Its membrane is that of Baraff and Witkin ("Large steps in cloth simulation", 1998), per area

    ½ k_u (|F_u| - 1)² + ½ k_v (|F_v| - 1)² + ½ k_s (cos angle of F_u and F_v)²,

with F_u and F_v the images of the unit vectors along weft and warp. Nothing couples weft and warp: its Poisson ratio along them
is 0, and k_u = k_v = E h and k_s = h μ are hood's tension of a free strip along weft or warp and hood's shear, in small strain.
A strip at 45° to them is a fifth softer than hood's. Forces of its shear leave out a part that is of second order in strain.

Bending is the quadratic energy of Bergou et al. (2006), flat at rest: a hinge folded by θ has ½ K (2 sin θ/2)², where hood has
½ K (θ - θ₀)²; edge_ke = K (A₁ + A₂) / (3 l₀²).

Every face is a panel of its own, laid out as hood's face is at rest, with its warp as near to the vertical as the face allows.

Damping: Style3D multiplies velocities by 0.998 in every step, and has no option against it.
"""

from __future__ import annotations

import contextlib
import io
from typing import TYPE_CHECKING, Any

import numpy as np
from peer_scenes import LAYER_REACH, SLIP_SPEED, Membrane

if TYPE_CHECKING:
    from peer_newton import Effort


def panels(rest: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 3, 2) m: corners of the ``faces`` (F, 3) of a garment at ``rest`` (V, 3), laid out flat, by weft and warp.

    The warp is the direction in the face next to y; where the face is nearly level, next to z.
    """
    corners = rest[faces]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(first, second)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    level = np.abs(normal[:, 1]) > 0.99
    warp = np.where(level[:, None], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0])
    warp = warp - (warp * normal).sum(axis=1, keepdims=True) * normal
    warp /= np.linalg.norm(warp, axis=1, keepdims=True)
    weft = np.cross(warp, normal)
    along = corners - corners[:, :1]
    return np.stack([(along * weft[:, None]).sum(axis=2), (along * warp[:, None]).sum(axis=2)], axis=2)


def add_cloth(newton: Any, warp: Any, builder: Any, law: Membrane, rest: np.ndarray, faces: np.ndarray, radius: float) -> None:
    """A garment at ``rest`` (V, 3) m with the membrane ``law``, of ``faces`` (F, 3); mass and bending are set afterwards."""
    newton.solvers.SolverStyle3D.register_custom_attributes(builder)
    newton.solvers.style3d.add_cloth_mesh(
        builder,
        pos=warp.vec3(0.0, 0.0, 0.0),
        rot=warp.quat_identity(),
        vel=warp.vec3(0.0, 0.0, 0.0),
        vertices=rest.tolist(),
        indices=faces.reshape(-1).tolist(),
        density=1.0,
        panel_verts=panels(rest, faces).reshape(-1, 2).tolist(),
        panel_indices=np.arange(faces.size).tolist(),
        tri_aniso_ke=[warp.vec3(law.young, law.young, law.mu)] * len(faces),
        edge_kd=0.0,
        particle_radius=radius,
    )


def make_solver(newton: Any, model: Any, effort: Effort, touching: bool) -> Any:
    """The solver; without any contact unless cloth may be ``touching`` the body, or itself by ``effort``.

    Its inner products and what searches for cloth near cloth are left out of graphs of launches on a CPU. The products are
    taken by Warp's own call, which is recorded; where nobody asks for cloth near cloth it is not searched for.
    """
    kind = newton.solvers.SolverStyle3D
    config = kind.Config(iterations=effort.iterations, linear_iterations=effort.linear)
    # It prints how long it prepared.
    with contextlib.redirect_stdout(io.StringIO()):
        solver = kind(model, config=config)
    solver.linear_solver = _recorded(solver.linear_solver)
    collision = solver.collision
    collision.friction_epsilon = SLIP_SPEED
    # Cloth counts as touching within twice this radius.
    collision.radius = 0.5 * LAYER_REACH
    if not effort.self_contact:
        collision.stiff_vf = collision.stiff_ee = collision.stiff_ef = 0.0
        collision.frame_begin = _nothing
    if not (touching or effort.self_contact):
        solver.collision = None
    return solver


def _recorded(linear: Any) -> Any:
    """The same solver of linear equations with inner products that a graph records."""
    from warp.utils import array_inner

    def residual(number: int) -> None:
        array_inner(linear.r, linear.z, out=linear.rTz[number : number + 1])

    def curvature(number: int) -> None:
        array_inner(linear.p, linear.Ap, out=linear.pTAp[number : number + 1])

    linear.step3_update_rTz, linear.step6_update_pTAp = residual, curvature
    return linear


def _nothing(*_: Any) -> None:
    pass
