"""A scene: one garment, and one body in motion or none. It prescribes the start and every step; it never changes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment, checked_garment
from hood.assets.material import NO_GRADIENT, Material
from hood.assets.motion.sequence import PoseSequence
from hood.cloth.cloth import Cloth, build_cloth
from hood.cloth.state import Attachments, State, StepInput, centres_of
from hood.mesh.flat import followed
from hood.scene.body_motion.motion import BodyMotion, Motion, body_motion
from hood.scene.following import Held
from hood.scene.holding import Fastening, Holding, fastening_of
from hood.scene.sizing import GarmentSize, Sizes, resized, sizes_of
from hood.scene.start import free_stretch, leave_by_centroids, settle
from hood.scene.untangle import Outfit, Separation, separate, smooth_out
from hood.scene.worn import worst_part
from hood.tensors.batch import to_device

#: Time step [s] of the relaxing first step: inertia shrinks by 100, the paper's α (section 3.4).
RELAXING_DT = 1.0 / 3.0
#: The local frame follows the cloth in multiples of this [m]; such shifts are exact in float32 near the cloth.
_GRID = 0.25
#: A garment that is worn stretches no edge by so much more when it is taken out of the body; measured: 0 there, 0.9 to 2.1
#: where it was made for another pose.
_TORN = 0.4
#: Seconds in which a body moves from the T-pose into a frame that a garment cannot be put on in.
LEAD_IN = 1.0


class NotWornError(ValueError):
    """A garment passes through the body in the frame that it is to start in."""


@dataclass(frozen=True)
class Scene:
    """Static description of one rollout. Steps are numbered by the frame they start from."""

    cloth: Cloth  # what is simulated
    garment: Garment  # what it was made of
    motion: Motion  # the body
    dt: float  # s, of a step
    clearance: float = 2e-3  # m, from the skin, that a garment is put on with
    start_pos: np.ndarray | None = None  # (V, 3) m, world, float64: frame 0 starts there, and is not settled
    start_vel: np.ndarray | None = None  # (V, 3) m/s, likewise
    layers: tuple[int, ...] | None = None  # garments of an outfit from the body outwards; None: as they lie at the start
    sizes: Sizes = Sizes()  # of the rest shape; that of ``cloth`` is the first
    fastening: Fastening | None = None  # of steps that are given no attachments; None: nothing is fastened
    holding: Holding | None = None  # what is held and let go; None: the pins of ``cloth``, throughout
    held: Held | None = None  # what pins follow, and soft ones; None: all are held exactly where the skinned garment has them
    friction_scale: Tensor | None = None  # (G,) factors on the coefficient of friction on the body's faces; None: 1

    def cloth_at(self, frame: int, start: int = 0) -> Cloth:
        """The cloth at ``frame`` of a rollout that begins at the frame ``start``: ``cloth`` where its size does not change."""
        now = self.sizes.at((frame - start) * self.dt)
        return self.cloth if now == self.sizes.start else resized(self.cloth, self.sizes.start, now)

    def cloth_of_step(self, frame: int, start: int = 0) -> Cloth:
        """The cloth of the step ``frame`` → ``frame + 1`` of a rollout that begins at the frame ``start``: of the size that it
        ends with, with what is held in it."""
        cloth = self.cloth_at(frame + 1, start) if self.sizes.changing else self.cloth
        return cloth if self.holding is None else self.holding.cloth(cloth, frame)

    def skinned(self, frame: int, origin: np.ndarray) -> Tensor:
        """(V, 3) m: the garment moving with the body alone at ``frame``, relative to ``origin``; pins that follow the skin with
        that."""
        pos = self.motion.skinned(self.garment, frame, origin)
        return pos if self.held is None else self.held.placed(pos, self.motion.surface(frame, origin))

    @property
    def num_frames(self) -> int:
        """Frames of the motion; a rollout has at most as many."""
        return self.motion.num_frames

    def start(self, frame: int = 0, relaxed: bool = True, thorough: bool = False, by_centroids: bool = False) -> State:
        """State at ``frame``: garment skinned to the body, settled; velocity of the skinned garment.

        ``relaxed=False`` gives zero velocity, the start of a relaxing step; ``thorough`` as in
        :func:`hood.scene.start.settle`; ``by_centroids`` takes it out of the body by
        :func:`hood.scene.start.leave_by_centroids` instead, with its edges as they were skinned.

        Raises:
            NotWornError: a thorough start finds the garment passing through the body, as one does that was made for another
                pose: out of the body, it is torn.
        """
        vel = self.start_velocity(frame) if relaxed else torch.zeros_like(self.cloth.rest_pos)
        if self.start_pos is not None and frame == 0:
            origin = local_origin(self.start_pos.mean(axis=0), 2 * _GRID)  # where a rollout would move it, see recentre
            pos = torch.as_tensor(self.start_pos - origin).to(self.cloth.rest_pos)
            return State(pos=pos, vel=vel, origin=torch.as_tensor(origin).unsqueeze(0))
        origin = local_origin(self.motion.translation[frame])
        skinned = self.skinned(frame, origin)
        obstacle = self.motion.obstacle(frame, origin, static=True)
        if by_centroids and obstacle is not None:
            pos = leave_by_centroids(self.cloth, skinned, obstacle, self.clearance)
        else:
            pos = settle(self.cloth, skinned, obstacle, self.clearance, thorough=thorough)
        if thorough:
            self._require_worn(frame, skinned, pos)
        return State(pos=pos, vel=vel, origin=torch.as_tensor(origin).unsqueeze(0))

    @property
    def outfit(self) -> Outfit | None:
        """The garments, where they are several."""
        piece = self.garment.piece
        if piece is None or not piece.any():
            return None
        count = int(piece.max()) + 1
        names = tuple(self.garment.name.split("+"))
        return Outfit(
            self.cloth, self.garment.faces, piece, names if len(names) == count else tuple(map(str, range(1, count + 1)))
        )

    def taken_apart(self, state: State, frame: int = 0) -> tuple[State, Separation | None]:
        """``state`` at ``frame`` with no cloth through cloth, as far as that can be had: places smoothed where a garment passes
        through itself (:func:`hood.scene.untangle.smooth_out`), and the garments of an outfit taken apart; how that was, None
        of a single garment.

        Raises:
            TangledError: triangles of two garments still pass through each other.
        """
        obstacle = self.motion.obstacle(frame, state.origin[0].numpy(), static=True)
        outfit, cloth, pos, found, device = self.outfit, self.cloth, state.pos, None, state.pos.device
        if device.type != "cpu":  # the searches for what passes through what are on the host
            cloth, pos, obstacle = to_device(cloth, "cpu"), pos.cpu(), obstacle and to_device(obstacle, "cpu")
            outfit = outfit and outfit._replace(cloth=cloth)
        if outfit is None:
            pos = smooth_out(cloth, self.garment.faces, pos, obstacle, self.clearance)
        else:
            garment = outfit.piece[outfit.faces[:, 0]]
            for number in range(len(outfit.names)):  # each by itself: where one passes through another nothing is smoothed
                pos = smooth_out(cloth, outfit.faces[garment == number], pos, obstacle, self.clearance)
            found = separate(outfit, pos, obstacle, self.clearance, self.layers)
            pos = found.pos
        return (state if pos is state.pos else State(pos.to(device), state.vel, state.origin)), found

    def _require_worn(self, frame: int, skinned: Tensor, settled: Tensor) -> None:
        """Settling shortens the edges of a garment that is worn, and lengthens those of one that a limb passes through."""
        if self.cloth.edges.shape[0] == 0:
            return
        given, now = (float(free_stretch(self.cloth, pos).max()) for pos in (skinned, settled))
        if now - max(given, 0.0) > _TORN:
            part = worst_part(self, settled.double().cpu().numpy())
            raise NotWornError(
                f"garment {self.garment.name!r}: {part}{' ' * bool(part)}passes through {self.motion.name!r} in frame {frame} "
                f"(taken out of it, edges are stretched by {100 * now:.0f}%); give it as it is worn there, bind it to a body "
                "with the pose it was made in (hood prepare pose=…), or start from another frame or a standing pose (start=…, "
                "blend_in=3)"
            )

    def lead_in(self, frame: int) -> Scene | None:
        """The ``LEAD_IN`` seconds before ``frame``, in which the body moves there from the T-pose and its garment is worn from
        the start; the last frame is ``frame``. None for a body that is not posed by joints.

        Raises:
            NotWornError: the garment passes through the body in the T-pose too.
        """
        if not isinstance(self.motion, BodyMotion):
            return None
        fastening = None if self.fastening is None else self.fastening.still(frame)
        motion = self.motion.lead_in(frame, LEAD_IN)
        lead = replace(self, motion=motion, start_pos=None, start_vel=None, fastening=fastening, holding=None)
        start = lead.start(0, relaxed=False, thorough=True)
        return replace(lead, start_pos=start.pos.cpu().double().numpy() + start.origin[0].numpy())

    def start_velocity(self, frame: int) -> Tensor:
        """(V, 3) m/s of the skinned garment at ``frame``."""
        if self.start_vel is not None and frame == 0:
            return torch.as_tensor(self.start_vel).to(self.cloth.rest_pos)
        if frame + 1 >= self.num_frames:
            return torch.zeros_like(self.cloth.rest_pos)
        origin = self.motion.translation[frame]
        return (self.skinned(frame + 1, origin) - self.skinned(frame, origin)) / self.dt

    def skinned_acceleration(self, frame: int) -> Tensor:
        """(V, 3) m per frame²: x⁺ − 2x + x⁻ of the skinned garment at ``frame``, or at the nearest frame that has both
        neighbours; zero for motions of two frames."""
        if self.num_frames < 3:
            return torch.zeros_like(self.cloth.rest_pos)
        frame = min(max(frame, 1), self.num_frames - 2)
        origin = self.motion.translation[frame]
        before, now, after = (self.skinned(frame + k, origin) for k in (-1, 0, 1))
        return after - 2 * now + before

    def step_input(
        self,
        frame: int,
        state: State,
        relaxing: bool = False,
        attachments: Attachments | None = None,
        jumping: bool = False,
    ) -> StepInput:
        """What is prescribed for ``frame`` → ``frame + 1``; a relaxing step freezes the body at ``frame``. Without
        ``attachments`` they are those of the scene's fastening. Where the body is ``jumping``, held vertices jump with it."""
        if attachments is None and self.fastening is not None:
            attachments = self.fastening.at(frame, None if relaxing else state.pos, self.dt)
        origin = state.origin[0].numpy()
        pins = None
        cloth = self.cloth if self.holding is None or relaxing else self.holding.cloth(self.cloth, frame)
        soft = self._soft_pins(frame, relaxing)
        if cloth.has_pinned or soft is not None:
            pins = self.skinned(frame if relaxing else frame + 1, origin)
            if self.holding is not None and not relaxing and not jumping:
                here = self.skinned(frame, origin)
                pins = self.holding.targets(frame, here, pins, state.pos, self.dt)
        dt = RELAXING_DT if relaxing else self.dt
        time = (frame if relaxing else frame + 1) * self.dt
        obstacle = self.motion.obstacle(frame, origin, static=relaxing)
        if obstacle is not None and self.friction_scale is not None:
            obstacle = replace(obstacle, friction_scale=self.friction_scale.to(obstacle.pos))
        return StepInput(
            dt=state.pos.new_full((1,), dt),
            obstacle=obstacle,
            pin_target=pins,
            attachments=attachments,
            time=state.pos.new_full((1,), time),
            pin_stiffness=soft,
        )

    def _soft_pins(self, frame: int, relaxing: bool) -> Tensor | None:
        """(V,) N/m of springs in the step of ``frame``; None where there are none."""
        if self.held is None or self.held.stiffness is None or self.holding is None or relaxing:
            return None if self.held is None else self.held.stiffness
        return torch.where(self.holding.let_go(frame, self.held.stiffness > 0), 0.0, self.held.stiffness)


def build_scene(
    garment: Garment,
    body: Body,
    sequence: PoseSequence,
    material: Material | None = None,
    betas: np.ndarray | None = None,
    size: GarmentSize | Sizes = 1.0,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Scene:
    """A garment on a body in motion, ready to be simulated; an unbound garment is bound to the body.

    Args:
        garment: in the body's T-pose; it grows with the body's shape.
        body: who wears it.
        sequence: the body's motion; its frame rate is that of the simulation.
        material: the fabric; None: the default one.
        betas: (S,) shape coefficients of the body; None: zeros.
        size: factor of the rest shape alone, the paper's resizing augmentation; three factors along its axes, or
            :class:`hood.scene.sizing.Sizes` that change during the rollout.
        dtype: of the cloth's positions.
        device: ``cpu`` or ``cuda``.

    Raises:
        ValueError: an argument of another type, a garment of arrays that cannot be simulated, or one that cannot follow the
            body or is not on it in the motion's first frame.

    Examples:
        >>> import hood
        >>> scene = hood.build_scene(hood.load_garment("tank"), hood.load_body(), hood.load_sequence("plie"))
        >>> scene.cloth.num_vertices, round(1 / scene.dt)
        (1016, 30)
        >>> state = scene.start()  # frame 0, on the body
        >>> tuple(state.pos.shape)
        (1016, 3)
    """
    garment = checked_garment(garment)
    for kind, given, loaded in ((Body, body, "hood.load_body()"), (PoseSequence, sequence, "hood.load_sequence('plie')")):
        if not isinstance(given, kind):
            raise ValueError(f"build_scene takes a hood.{kind.__name__}, such as {loaded}, not {type(given).__name__}")
    if material is not None and not isinstance(material, Material):
        raise ValueError(f"build_scene takes a hood.Material, or None for the default fabric, not {type(material).__name__}")
    if getattr(betas, "requires_grad", False):
        raise ValueError(f"betas: {NO_GRADIENT}")
    betas = np.zeros(10) if betas is None else np.asarray(betas, dtype=np.float64)
    return dressed_scene(garment, body_motion(body, sequence, betas, dtype, device), material, size)


def dressed_scene(garment: Garment, motion: Motion, material: Material | None = None, size: GarmentSize | Sizes = 1.0) -> Scene:
    """Garment on whatever moves, in the motion's precision and on its device; ``size`` scales the rest shape, which is that of
    the body's shape if it is made to measure.

    Raises:
        ValueError: the garment cannot follow the body, or is not on it in the motion's first frame.
    """
    garment = motion.dressed(garment)
    sizes = size if isinstance(size, Sizes) else sizes_of(size)
    rest_pos = (motion.rest_pos(garment) if sizes.to_measure else garment.rest_pos) * np.array(sizes.start)
    uv = None if garment.uv is None or garment.uv_faces is None else (garment.uv, garment.uv_faces)
    flat = None if garment.flat is None else followed(garment.flat, garment.faces, garment.rest_pos, rest_pos)
    cloth = build_cloth(
        rest_pos, garment.faces, material or Material(), garment.pinned,
        stiffness=garment.stiffness, dtype=motion.dtype, uv=uv, flat=flat, made=garment.construction,
    )  # fmt: skip
    cloth = to_device(cloth, motion.device)
    fastening = fastening_of(garment.fasteners, cloth.rest_pos)
    return Scene(cloth, garment, motion, 1.0 / motion.fps, sizes=sizes, fastening=fastening)


def recentre(state: State, vertex_scene: Tensor, centres: Tensor | None = None) -> State:
    """The same state with each scene's origin moved next to its cloth; world positions are unchanged.

    Args:
        centres: :func:`centres_of` the positions, on the CPU, where they are known; otherwise this waits for the device, once.
    """
    if centres is None and len(state.origin) == 1 and state.pos.device.type == "cpu":
        # Below the half that is rounded up.
        if all(abs(value) < 0.99 * _GRID for value in state.pos.mean(dim=0).tolist()):
            return state
    known = centres_of(state.pos, vertex_scene, len(state.origin)).cpu() if centres is None else centres
    # A broken cloth has no centre; its frame stays, so that the body can still be seen.
    shift = torch.round(known.nan_to_num(0.0, 0.0, 0.0) / (2 * _GRID)) * (2 * _GRID)
    if not bool(shift.any()):
        return state
    return State(state.pos - shift.to(state.pos)[vertex_scene], state.vel, state.origin + shift.to(torch.float64))


def local_origin(position: np.ndarray, grid: float = _GRID) -> np.ndarray:
    """The origin (3,) [m] of a state near a position: a multiple of the grid."""
    return np.round(position / grid) * grid
