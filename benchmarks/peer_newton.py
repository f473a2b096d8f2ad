"""Cloth of NVIDIA Newton in the scenes of benchmarks/peers.py: its solvers VBD, XPBD and Style3D, on a CPU.

How hood's fabric is said in Newton's terms:

- mass: that of every vertex is hood's; what is held is inactive.
- VBD's membrane is stable neo-Hookean; with tri_ke = h μ and tri_ka = h λ [N/m] it is hood's in the limit of small strain.
- VBD's bending is hood's, hinge by hinge: edge_ke = k l₀ / (4 (A₁ + A₂)).
- XPBD has no membrane: springs along the edges, of E h Σ A / l², and bending. The gradient of the angle that its kernel takes
  is 2 A times the angle's, with A the area of a face; edge_ke is divided by A₁ + A₂ for that.
- Style3D: weft and warp as stiff as a free strip, E h, and shear h μ; bending flat at rest; see ``peer_style3d.py``.
- contact: radius of the particles 2 mm; soft_contact_ke as :func:`peer_scenes.contact_stiffness`, linear where hood's is
  quadratic; friction with the same coefficient and, but for XPBD, the same speed below which it counts as static.
- contact of cloth with cloth, where it is asked for, sets in at 3 mm, as hood's. VBD's is as stiff as that with the body. It
  stops vertices that move farther in a step than a share of what it searches, so it searches as far as 3 m/s need. Style3D's
  takes its stiffness from the matrix of the step. XPBD's is between particles, which leaves the faces between them open.
- no damping (tri_kd, edge_kd, soft_contact_kd are 0), but for what Style3D does to velocities.

The body is one mesh shape whose vertices and their velocities are set in every substep, in between frames on a straight line.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import peer_style3d
from peer_scenes import (
    CONTACT_RADIUS,
    FPS,
    FRICTION,
    GRAVITY,
    LAYER_REACH,
    SLIP_SPEED,
    CannotDoError,
    Moment,
    Setting,
    contact_stiffness,
    hinge_stiffness,
    membrane,
    spring_stiffness,
)

#: The weight of hood's contact [J/m³] that contact is made as stiff as.
COLLISION_WEIGHT = 5e5
#: Speed [m/s] up to which VBD lets cloth move that it keeps apart.
_FASTEST = 3.0


@dataclass(frozen=True)
class Effort:
    """How much one frame is worked on."""

    solver: str  # vbd, xpbd or style3d
    substeps: int
    iterations: int
    radius: float = CONTACT_RADIUS  # m, of the particles
    surface: bool = False  # contact of edges and faces as well
    linear: int = 10  # iterations in an iteration of Style3D; 10 is Newton's default
    self_contact: bool = False  # contact of cloth with cloth

    @property
    def name(self) -> str:
        apart = "" if self.radius == CONTACT_RADIUS else f", {1e3 * self.radius:g} mm"
        inner = "" if self.linear == 10 else f"x{self.linear}"
        return f"{self.solver}{'-surface' * self.surface} {self.substeps}x{self.iterations}{inner}{apart}"


def packages() -> tuple[Any, Any]:
    """The modules ``newton`` and ``warp``.

    Raises:
        SystemExit: they are not installed.
    """
    try:
        import warp

        warp.config.log_level = warp.LOG_ERROR
        import newton
    except ImportError as missing:
        raise SystemExit(f"{missing}; Newton comes with: pip install newton==1.8.0 warp-lang==1.19.0") from None
    return newton, warp


class Newton:
    """A scene in Newton, from frame 0.

    Raises:
        CannotDoError: XPBD and contact of cloth with cloth.
    """

    def __init__(self, setting: Setting, effort: Effort) -> None:
        if effort.self_contact and effort.solver == "xpbd":
            raise CannotDoError("XPBD in Newton 1.8 keeps particles apart, not the faces between them")
        self.newton, self.warp = packages()
        self.name, self.setting, self.effort = effort.name, setting, effort
        self._frame = 0
        self._mesh: Any = None
        self.model = self._build()
        self._states = [self.model.state(), self.model.state()]
        self.put(setting.start)
        self.solver = self._make_solver()
        self._control = self.model.control()
        self._pipeline: Any = None
        if self._mesh is not None or (effort.self_contact and effort.solver == "style3d"):
            surface = {"enable_rigid_soft_full_surface_contact": effort.surface}
            self._pipeline = self.newton.CollisionPipeline(self.model, **surface)
        self._contacts = None if self._pipeline is None else self._pipeline.contacts()
        self._graphs: list[Any] = []
        self._capture()

    def _make_solver(self) -> Any:
        effort, solvers = self.effort, self.newton.solvers
        if effort.solver == "style3d":
            return peer_style3d.make_solver(self.newton, self.model, effort, self._mesh is not None)
        if effort.solver == "xpbd":
            return solvers.SolverXPBD(self.model, iterations=effort.iterations)
        options: dict[str, Any] = {}
        if effort.self_contact:
            # A vertex may move 0.5 * 0.85 times the distance that is searched.
            reach = 2.0 * _FASTEST / (FPS * effort.substeps * 0.85)
            options = {
                "particle_self_contact_margin": LAYER_REACH,
                "particle_self_contact_gap": max(reach, 1.5 * LAYER_REACH) - LAYER_REACH,
            }
        return solvers.SolverVBD(
            self.model,
            iterations=effort.iterations,
            friction_epsilon=SLIP_SPEED,
            particle_enable_self_contact=effort.self_contact,
            **options,
        )

    def _add_cloth(self, builder: Any) -> None:
        wp, setting, law = self.warp, self.setting, membrane(self.setting.fabric)
        rest, faces = setting.cloth.rest_pos.numpy(), setting.cloth.faces.numpy()
        if self.effort.solver == "style3d":
            peer_style3d.add_cloth(self.newton, wp, builder, law, rest, faces, self.effort.radius)
            return
        builder.add_cloth_mesh(
            pos=wp.vec3(0.0, 0.0, 0.0),
            rot=wp.quat_identity(),
            scale=1.0,
            vel=wp.vec3(0.0, 0.0, 0.0),
            vertices=[wp.vec3(*point) for point in rest],
            indices=faces.reshape(-1).tolist(),
            density=float(np.asarray(setting.fabric.density)),
            tri_ke=law.mu,
            tri_ka=law.lam,
            tri_kd=0.0,
            edge_ke=1.0,
            edge_kd=0.0,
            particle_radius=self.effort.radius,
        )
        if self.effort.solver == "xpbd":
            ends = setting.cloth.edges.numpy()
            for (a, b), stiffness in zip(ends.tolist(), spring_stiffness(rest, faces, ends, law.young), strict=True):
                builder.add_spring(a, b, float(stiffness), 0.0, control=0.0)

    def _build(self) -> Any:
        newton, setting = self.newton, self.setting
        builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=(0.0, -GRAVITY, 0.0))
        self._add_cloth(builder)
        contact = contact_stiffness(setting.cloth, COLLISION_WEIGHT)
        if setting.body.shape[1]:
            self._mesh = newton.Mesh(
                setting.body[0].astype(np.float32), np.asarray(setting.scene.motion.faces).reshape(-1).astype(np.int32)
            )
            config = newton.ModelBuilder.ShapeConfig(ke=contact, kd=0.0, mu=FRICTION)
            builder.add_shape_mesh(body=-1, mesh=self._mesh, cfg=config)
        if self.effort.solver == "vbd":
            builder.color(include_bending=True)
        model = builder.finalize(device="cpu")
        model.edge_bending_properties.assign(self._bending(model.edge_indices.numpy()))
        self._hold(model)
        model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = contact, 0.0, FRICTION
        model.particle_mu = FRICTION
        if self._mesh is not None:
            self._bound(model)
        return model

    def _bending(self, edges: np.ndarray) -> np.ndarray:
        """(E, 2) stiffness and damping of Newton's ``edges`` (E, 4): two opposite vertices, then the edge's."""
        cloth = self.setting.cloth
        length, area = cloth.hinge_rest_length.double().numpy(), cloth.hinge_area.double().numpy()
        unit = {"vbd": length, "xpbd": area, "style3d": 3.0 * length**2 / area}[self.effort.solver]
        stiffness = hinge_stiffness(cloth) / unit
        known = {frozenset(pair): float(k) for pair, k in zip(cloth.hinges[:, :2].tolist(), stiffness, strict=True)}
        return np.array([[known.get(frozenset(row[2:]), 0.0), 0.0] for row in edges.tolist()], dtype=np.float32)

    def _hold(self, model: Any) -> None:
        mass = self.setting.cloth.mass.numpy().astype(np.float32)
        held = self.setting.pinned
        flags = model.particle_flags.numpy()
        flags[held] &= ~int(self.newton.ParticleFlags.ACTIVE)
        model.particle_flags = self.warp.array(flags, dtype=self.warp.int32, device="cpu")
        model.particle_mass.assign(mass)
        model.particle_inv_mass.assign(np.where(held, 0.0, 1.0 / np.where(mass > 0, mass, 1.0)).astype(np.float32))

    def _bound(self, model: Any) -> None:
        """The box that contact with the body is searched in holds all of its frames."""
        low, high = self.setting.body.min(axis=(0, 1)), self.setting.body.max(axis=(0, 1))
        model.shape_collision_aabb_lower.assign(low[None].astype(np.float32))
        model.shape_collision_aabb_upper.assign(high[None].astype(np.float32))
        model.shape_collision_radius.assign(np.array([np.linalg.norm(np.abs(self.setting.body).max(axis=(0, 1)))], np.float32))

    def put(self, moment: Moment, frame: int = 0) -> None:
        """The cloth to ``moment`` at ``frame``."""
        for state in self._states:
            state.particle_q.assign(moment.pos.astype(np.float32))
            state.particle_qd.assign(moment.vel.astype(np.float32))
        self._frame = frame

    def step(self) -> float:
        """From one frame to the next; CPU milliseconds, without those that the body's poses took before."""
        count, dt = self.effort.substeps, 1.0 / FPS / self.effort.substeps
        body = self.setting.body
        ends = body[self._frame].astype(np.float32), body[min(self._frame + 1, len(body) - 1)].astype(np.float32)
        began = time.process_time()
        for number in range(count):
            if self._mesh is not None:
                self._pose(ends, (number + 1) / count)
            if self._graphs:
                self.warp.capture_launch(self._graphs[0])
                self._graphs.reverse()
                self._states.reverse()
            else:
                self._substep(dt)
        self._frame += 1
        return 1e3 * (time.process_time() - began)

    def _substep(self, dt: float) -> None:
        here, there = self._states
        here.clear_forces()
        if self._pipeline is not None:
            self._pipeline.collide(here, self._contacts)
        self.solver.step(here, there, self._control, self._contacts, dt)
        self._states = [there, here]

    def substep(self) -> None:
        """The first substep of a frame alone, of a scene without a body."""
        self._substep(1.0 / FPS / self.effort.substeps)

    def _capture(self) -> None:
        """Substeps from now on are replays of graphs of launches, as in Newton's examples: one from the first of the two states
        to the second, one back."""
        dt = 1.0 / FPS / self.effort.substeps
        self._substep(dt)  # compiles
        self.put(self.setting.start)
        graphs = []
        for _ in range(2):
            with self.warp.ScopedCapture(device="cpu") as capture:
                self._substep(dt)
            graphs.append(capture.graph)
        self.put(self.setting.start)
        self._graphs = graphs

    def _pose(self, ends: tuple[np.ndarray, np.ndarray], share: float) -> None:
        mesh = self._mesh.mesh
        mesh.points.assign(ends[0] + np.float32(share) * (ends[1] - ends[0]))
        mesh.velocities.assign(np.float32(FPS) * (ends[1] - ends[0]))
        mesh.refit()

    def now(self) -> Moment:
        """The cloth at this frame."""
        state = self._states[0]
        return Moment(state.particle_q.numpy().astype(np.float64), state.particle_qd.numpy().astype(np.float64))
