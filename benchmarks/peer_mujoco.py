"""Cloth of MuJoCo in the scenes of benchmarks/peers.py: a flex of triangles, on a CPU.

How hood's fabric is said in MuJoCo's terms:

- mass: that of every vertex is hood's; what is held is pinned.
- stretching: young, poisson and thickness of a membrane in plane stress, E h = 4 h μ (λ + μ) / (λ + 2 μ) and ν = λ / (λ + 2 μ);
  its law is St. Venant-Kirchhoff's, as hood's is.
- bending: a flex bends as the solid of its thickness does, E h³ / (12 (1 - ν²)); hood's fabric has a stiffness of its own. The
  compiled coefficients are multiplied so that a sheet on a wide cylinder feels as great a force as hood's: :func:`bend_factor`.
- no damping; contact of cloth with cloth, where it is asked for, is MuJoCo's own, hard from 3 mm.

Integrator ``discrete`` treats elasticity implicitly, ``Euler`` does not and needs shorter steps.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from peer_scenes import CONTACT_RADIUS, FPS, FRICTION, GRAVITY, LAYER_REACH, CannotDoError, Moment, Setting, membrane

from hood.cloth.state import State, StepInput
from hood.energies.bending import Bending
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem

#: Radius [m] of the cylinder that bending is compared on.
_WIDE = 2.0
_RIGID = (
    "meshes of MuJoCo 4.0 are rigid and collide as convex hulls; a moving skin would be a second flex with a mocap body at "
    "every vertex, which is not built here"
)


@dataclass(frozen=True)
class Effort:
    """How a frame is divided."""

    integrator: str  # discrete or Euler
    substeps: int

    @property
    def name(self) -> str:
        return f"mujoco {self.integrator} {self.substeps}"


def package() -> Any:
    """The module ``mujoco``.

    Raises:
        SystemExit: it is not installed.
    """
    try:
        import mujoco
    except ImportError as missing:
        raise SystemExit(f"{missing}; MuJoCo comes with: pip install mujoco==4.0.0") from None
    return mujoco


def model_of(setting: Setting, effort: Effort, elastic: str) -> Any:
    """MuJoCo's model of a sheet at rest; ``elastic`` says what its elasticity does: bend, stretch or both."""
    law, thickness = membrane(setting.fabric), float(np.asarray(setting.fabric.thickness))
    points = " ".join(f"{value:.9g}" for value in setting.cloth.rest_pos.reshape(-1).tolist())
    elements = " ".join(map(str, setting.cloth.faces.reshape(-1).tolist()))
    held = " ".join(map(str, np.flatnonzero(setting.pinned)))
    touch, how, radius = (1, "auto", 0.5 * LAYER_REACH) if setting.self_contact else (0, "none", CONTACT_RADIUS)
    text = f"""
<mujoco>
  <option gravity="0 {-GRAVITY} 0" timestep="{1.0 / FPS / effort.substeps}" integrator="{effort.integrator}"/>
  <size memory="2G"/>
  <worldbody>
    <flexcomp name="cloth" type="direct" dim="2" mass="1" radius="{radius}" point="{points}" element="{elements}">
      <contact contype="{touch}" conaffinity="{touch}" selfcollide="{how}" friction="{FRICTION}"/>
      <edge equality="false"/>
      <elasticity young="{law.young / thickness}" poisson="{law.poisson}" thickness="{thickness}" elastic2d="{elastic}"/>
      <pin id="{held}"/>
    </flexcomp>
  </worldbody>
</mujoco>"""
    return package().MjModel.from_xml_string(text)


class MuJoCo:
    """A sheet in MuJoCo, from frame 0.

    Raises:
        CannotDoError: the scene has a body.
    """

    def __init__(self, setting: Setting, effort: Effort) -> None:
        if setting.body.shape[1]:
            raise CannotDoError(_RIGID)
        self.mujoco = package()
        self.name, self.setting, self._substeps = effort.name, setting, effort.substeps
        self.model = model_of(setting, effort, "both")
        self.model.flex_bending[:] *= bend_factor(setting, effort)
        self._bodies = self.model.flex_vertbodyid
        self._joints = self.model.body_jntadr[self._bodies]
        self._free = np.flatnonzero(~setting.pinned)
        mass = setting.cloth.mass.numpy()
        share = mass[self._free] / self.model.body_mass[self._bodies[self._free]]
        self.model.body_mass[self._bodies[self._free]] *= share
        self.model.body_inertia[self._bodies[self._free]] *= share[:, None]
        self._data = self.mujoco.MjData(self.model)
        self.mujoco.mj_setConst(self.model, self._data)
        self._rest = setting.cloth.rest_pos.numpy()
        self._place()
        self.put(setting.start)

    def _place(self) -> None:
        """What is held goes where the scene has it: vertices of the world's body, in its frame."""
        held = np.flatnonzero(self.setting.pinned)
        self.model.flex_vert[held] += self.setting.start.pos[held] - self._rest[held]

    def put(self, moment: Moment, frame: int = 0) -> None:
        """The cloth to ``moment``, at any ``frame``: nothing else moves."""
        address = self.model.jnt_qposadr[self._joints[self._free]]
        speed = self.model.jnt_dofadr[self._joints[self._free]]
        for axis in range(3):
            self._data.qpos[address + axis] = (moment.pos - self._rest)[self._free, axis]
            self._data.qvel[speed + axis] = moment.vel[self._free, axis]
        self.mujoco.mj_forward(self.model, self._data)

    def step(self) -> float:
        """From one frame to the next; CPU milliseconds."""
        began = time.process_time()
        self.mujoco.mj_step(self.model, self._data, self._substeps)
        return 1e3 * (time.process_time() - began)

    def now(self) -> Moment:
        """The cloth at this frame."""
        self.mujoco.mj_kinematics(self.model, self._data)
        self.mujoco.mj_flex(self.model, self._data)
        vel = np.zeros_like(self._rest)
        speed = self.model.jnt_dofadr[self._joints[self._free]]
        vel[self._free] = np.stack([self._data.qvel[speed + axis] for axis in range(3)], axis=1)
        return Moment(np.array(self._data.flexvert_xpos), vel)


def bend_factor(setting: Setting, effort: Effort) -> float:
    """How many times as great the forces of bending are in hood as in MuJoCo, of the sheet on a cylinder of 2 m."""
    mujoco, rest = package(), setting.cloth.rest_pos.numpy()
    angle = (rest[:, 0] - rest[:, 0].mean()) / _WIDE
    round_ = np.stack([_WIDE * np.sin(angle) + rest[:, 0].mean(), _WIDE * (1.0 - np.cos(angle)), rest[:, 2]], axis=1)
    model = model_of(setting, effort, "bend")
    data = mujoco.MjData(model)
    free = np.flatnonzero(~setting.pinned)
    joints = model.body_jntadr[model.flex_vertbodyid][free]
    for axis in range(3):
        data.qpos[model.jnt_qposadr[joints] + axis] = (round_ - rest)[free, axis]
    held = np.flatnonzero(setting.pinned)
    model.flex_vert[held] += (round_ - rest)[held]
    mujoco.mj_forward(model, data)
    own = np.stack([data.qfrc_passive[model.jnt_dofadr[joints] + axis] for axis in range(3)], axis=1)
    here = torch.as_tensor(round_)
    state = State(here, torch.zeros_like(here), torch.zeros(1, 3, dtype=torch.float64))
    problem = StepProblem(setting.cloth, state, StepInput(torch.tensor([1.0 / FPS], dtype=torch.float64)))
    gradient, _ = Potential({"bending": Bending()}).gradient(problem, here)
    return float(np.linalg.norm(gradient.numpy()[free]) / np.linalg.norm(own))
