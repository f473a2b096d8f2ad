"""Training scenes: random motion window, body shape, garment, size and fabric (paper, section 4.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from hood.assets.body.body import Body
from hood.assets.garment.binding import bind_garment, hold_on_trunk
from hood.assets.garment.garment import Garment
from hood.assets.garment.mirror import mirror_body, mirror_garment
from hood.assets.material import RANGES, Material, sample_material
from hood.assets.motion.motion_files import MotionFiles, motion_lengths
from hood.assets.motion.sequence import PoseSequence, turn_world
from hood.cloth.cloth import Cloth
from hood.scene.body_motion.motion import BodyMotion, body_motion
from hood.scene.holding import fastening_of
from hood.scene.scene import Scene, dressed_scene
from hood.tensors.batch import to_device

#: Draws before a set of motions that cannot be read is given up.
_MAX_UNREADABLE = 100
#: Shape coefficients beyond are no body's: the models' axes are standard deviations.
_MOST_BETA = 10.0
#: Noise [m] beyond tears every garment.
_MOST_NOISE = 0.1


@dataclass(frozen=True)
class Window:
    """One training scene and the frame at which its rollout starts."""

    scene: Scene  # cloth and body
    start_frame: int  # of the scene's motion
    template: int = 0  # index into the sampler's garments
    mirrored: bool = False  # the scene is shown as its image x → −x
    still: bool = False  # a rollout of one step holds the body still for a regular dt, and is no relaxing step

    def to(self, device: torch.device | str) -> Window:
        """The same with the scene's tensors on ``device``."""
        scene = self.scene
        assert isinstance(scene.motion, BodyMotion)
        _ = scene.cloth.has_pinned  # is known to the host there as well
        motion = scene.motion.with_surfaces(scene.motion.posed, device)
        return replace(self, scene=replace(scene, cloth=to_device(scene.cloth, device), motion=motion))


@dataclass(frozen=True)
class Drawn:
    """What a training scene is made of."""

    template: int  # index into the sampler's garments
    #: With a frame before the start frame, where there is one, and all frames that are asked for behind it.
    sequence: PoseSequence
    start_frame: int  # in ``sequence``
    betas: np.ndarray  # shape coefficients of the body
    size: float  # factor of the garment
    material: Material  # the fabric
    mirrored: bool = False  # the scene is shown as its image x → −x
    still: bool = False  # see :class:`Window`


class SceneSampler:
    """Draws training scenes; a scene is a function of the generator alone, so a seed replays it.

    A data set of one's own is a subclass that overrides :meth:`draw`: what comes of it goes through workers, resumes and
    several processes as here. It takes the arguments of this class beside its own ones, and takes all chance from ``rng``.

    Scenes are made on the CPU, whatever device they are moved to.

    Args:
        body: the body to dress.
        garments: templates, drawn uniformly.
        sequences: motions, drawn by their length; :class:`hood.assets.motion.motion_files.MotionFiles` are read when drawn.
        beta_range: shape coefficients are U(-beta_range, beta_range).
        size_range: garment scale is uniform in this interval.
        piecewise_fraction: share of the scenes with several fabrics on one garment, where fabrics are drawn.
        random_yaw: turn the world about the vertical axis, so that no direction is special.
        mirror: show every other scene, at random, as its image x → −x, so that no side is special: without it, what a
            network learns from lopsided motions lets cloth drift sideways on a body that stands still.
        material: fabric of every scene; None: drawn (:func:`hood.assets.material.sample_material`).
        uniform: properties of the fabric that are drawn uniformly; the others are log-uniform.
        still_fraction: share of the rollouts of one step whose step is a regular one with a still body, not the relaxing one.
        by_centroids: scenes begin as by :func:`hood.scene.start.leave_by_centroids`, not settled.
        noise: standard deviation [m] of normal noise on every coordinate of x_t and of x_{t−1} at the start, independent;
            :func:`hood.training.prefetch.make_start` adds it.
        noise_on_pinned: pinned vertices have it as well.
        device: where the scenes' tensors live in training.

    Raises:
        ValueError: no garment, no motion, or a range that nothing can be drawn from; names the key.
    """

    def __init__(
        self,
        body: Body,
        garments: Sequence[Garment],
        sequences: Sequence[PoseSequence],
        beta_range: float = 2.0,
        size_range: tuple[float, float] = (0.9, 1.1),
        piecewise_fraction: float = 0.2,
        random_yaw: bool = True,
        mirror: bool = True,
        material: Material | None = None,
        device: str = "cpu",
        uniform: Sequence[str] = (),
        still_fraction: float = 0.0,
        by_centroids: bool = False,
        noise: float = 0.0,
        noise_on_pinned: bool = False,
    ) -> None:
        if not garments or not sequences:
            raise ValueError("training needs at least one garment and one motion (data.garments, data.sequences)")
        _check_ranges(beta_range, size_range)
        if not 0 <= noise <= _MOST_NOISE:
            raise ValueError(f"data.sampling.noise is {noise}; give metres, 0 to {_MOST_NOISE:g}, such as 3.0e-3")
        _check_shares(piecewise_fraction=piecewise_fraction, still_fraction=still_fraction)
        _check_properties(uniform)
        self.body = body
        self.garments = [hold_on_trunk(bind_garment(garment, body), body) for garment in garments]
        self.sequences = sequences if isinstance(sequences, MotionFiles) else list(sequences)
        self._lengths = motion_lengths(self.sequences)
        self.beta_range = beta_range
        self.size_low, self.size_high = size_range
        self.piecewise_fraction = piecewise_fraction
        self.random_yaw, self.mirror = random_yaw, mirror
        self.material = material
        self.uniform = tuple(uniform)
        self.still_fraction = still_fraction
        self.by_centroids = by_centroids
        self.noise, self.noise_on_pinned = noise, noise_on_pinned
        self.device = device

    def sample(self, rng: np.random.Generator, num_steps: int, garment: int | None = None) -> Window:
        """A scene on the CPU with at least ``num_steps`` steps ahead of its start frame.

        ``garment`` fixes the template by its index; None draws one.

        Raises:
            ValueError: every motion is shorter than that, or a motion that was drawn cannot be read.
        """
        drawn = self.draw(rng, num_steps, garment)
        given, needed = drawn.sequence.num_frames, drawn.start_frame + num_steps + 2
        if given < needed:
            raise ValueError(
                f"data: {type(self).__qualname__}.draw gave {given} frames with start_frame={drawn.start_frame} for "
                f"{num_steps} steps; give at least start_frame + num_steps + 2 = {needed}"
            )
        body, worn = self._assets(drawn.template, drawn.mirrored)
        motion = body_motion(body, drawn.sequence, np.asarray(drawn.betas, dtype=np.float64))
        scene = dressed_scene(worn, motion, drawn.material, drawn.size)
        return Window(scene, drawn.start_frame, drawn.template, drawn.mirrored, drawn.still)

    def draw(self, rng: np.random.Generator, num_steps: int, garment: int | None = None) -> Drawn:
        """What a scene is made of, with the arguments and errors of :meth:`sample`. A class of one's own overrides this."""
        index = int(rng.integers(len(self.garments))) if garment is None else garment % len(self.garments)
        template = self.garments[index]
        window, start = self._draw_motion(rng, num_steps)
        if self.random_yaw:
            turn = Rotation.from_rotvec([0.0, rng.uniform(-np.pi, np.pi), 0.0]).as_matrix()
            window = turn_world(window, turn)
        betas = np.asarray(rng.uniform(-self.beta_range, self.beta_range, self.body.shapedirs.shape[2]))
        size = float(rng.uniform(self.size_low, self.size_high))
        material = self.material or sample_material(rng, template.rest_pos, self.piecewise_fraction, uniform=self.uniform)
        mirrored = self.mirror and rng.random() < 0.5
        still = self.still_fraction > 0 and rng.random() < self.still_fraction
        return Drawn(index, window, min(start, 1), betas, size, material, mirrored, still)

    def pack(self, window: Window) -> dict[str, Any]:
        """A sampled window as plain arrays, without the body and the garment that every process has; surfaces posed."""
        motion = window.scene.motion
        assert isinstance(motion, BodyMotion)
        return {
            "cloth": {field.name: _to_numpy(getattr(window.scene.cloth, field.name)) for field in fields(Cloth)},
            "sequence": motion.sequence,
            "betas": motion.betas,
            "surfaces": {chunk: surface.numpy() for chunk, surface in motion.surfaces().items()},
            "start_frame": window.start_frame,
            "template": window.template,
            "mirrored": window.mirrored,
            "still": window.still,
        }

    def unpack(self, packed: dict[str, Any]) -> Window:
        """What was packed, to the last bit, with this sampler's own body and garments."""
        body, garment = self._assets(packed["template"], packed["mirrored"])
        values: dict[str, Any] = {
            name: torch.from_numpy(v) if isinstance(v, np.ndarray) else v for name, v in packed["cloth"].items()
        }
        cloth = Cloth(**{spec.name: values[spec.name] for spec in fields(Cloth)})
        motion = body_motion(body, packed["sequence"], packed["betas"], cloth.rest_pos.dtype)
        surfaces = {chunk: torch.from_numpy(surface) for chunk, surface in packed["surfaces"].items()}
        posed, fastening = motion.with_surfaces(surfaces, "cpu"), fastening_of(garment.fasteners, cloth.rest_pos)
        scene = Scene(cloth, garment, posed, 1.0 / packed["sequence"].fps, fastening=fastening)
        return Window(scene, *(packed[name] for name in ("start_frame", "template", "mirrored", "still")))

    def _draw_motion(self, rng: np.random.Generator, num_steps: int) -> tuple[PoseSequence, int]:
        """Part of a motion with ``num_steps`` steps ahead of a start frame, and that frame in the whole motion."""
        weights = np.maximum(self._lengths - num_steps - 1, 0).astype(np.float64)
        if not weights.any():
            longest = int(self._lengths.argmax())
            raise ValueError(
                f"no motion has the {num_steps + 2} frames that a training rollout needs; the longest, "
                f"{self.sequences[longest].name!r}, has {self._lengths[longest]} (lower trainer.horizon.maximum or give longer "
                "motions)"
            )
        weights /= weights.sum()
        for _ in range(_MAX_UNREADABLE):
            index = int(rng.choice(len(weights), p=weights))
            start = int(rng.integers(self._lengths[index] - num_steps - 1))
            source = self.sequences
            sequence = source.usable(index) if isinstance(source, MotionFiles) else source[index]
            if sequence is not None:
                return sequence.window(max(start - 1, 0), start + num_steps + 2), start
        raise ValueError(f"{_MAX_UNREADABLE} motions drawn in a row could not be read; check the files of data.sequences")

    def _assets(self, index: int, mirrored: bool) -> tuple[Body, Garment]:
        if not mirrored:
            return self.body, self.garments[index]
        return self._mirrored_body, self._mirrored_garments[index]

    @cached_property
    def _mirrored_body(self) -> Body:
        return mirror_body(self.body)

    @cached_property
    def _mirrored_garments(self) -> list[Garment]:
        return [mirror_garment(garment) for garment in self.garments]


def _to_numpy(value: Any) -> Any:
    return value.numpy() if isinstance(value, Tensor) else value


def _check_ranges(beta_range: float, size_range: Sequence[float]) -> None:
    """Raise ValueError for ranges that nothing can be drawn from; names the key."""
    if not 0 <= beta_range <= _MOST_BETA:
        raise ValueError(f"data.sampling.beta_range is {beta_range}; give 0 (the mean body) to {_MOST_BETA:g}, such as 2.0")
    numbers = all(isinstance(size, (int, float)) for size in size_range)
    if not numbers or len(size_range) != 2 or not 0 < size_range[0] <= size_range[1]:
        raise ValueError(
            f"data.sampling.size_range is {list(size_range)}; give the least and the largest factor, above 0, such as [0.9,1.1]"
        )


def _check_shares(**shares: float) -> None:
    for name, share in shares.items():
        if not 0 <= share <= 1:
            raise ValueError(f"data.sampling.{name} is {share}; give a share of the scenes, 0 to 1")


def _check_properties(uniform: Sequence[str]) -> None:
    strange = next((name for name in uniform if name not in RANGES), None)
    if strange is not None or isinstance(uniform, str):
        raise ValueError(f"data.sampling.uniform is {uniform!r}; give a list of {', '.join(RANGES)}")
