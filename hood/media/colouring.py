"""Values at the garment's vertices as colours, and the bar that says what a colour means."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from hood.assets.files.said import install
from hood.mesh.closest_point.search import search_surface
from hood.mesh.editing.subdivision import Subdivision
from hood.rollouts.file.reader import RolloutData

_Picture = NDArray[np.uint8]

#: From low to high; lightness falls all the way, so that the order shows in grey as well.
_SCALE = np.array(
    [[0.98, 0.95, 0.82], [0.98, 0.78, 0.45], [0.93, 0.50, 0.28], [0.76, 0.24, 0.30], [0.48, 0.11, 0.36], [0.20, 0.05, 0.27]]
)
#: Of a vertex without a value: before the first step.
_UNKNOWN = (0.62, 0.64, 0.67)
#: Share of all values that the scale spans; the few beyond take its last colour.
_SPANNED = 0.995
#: What a garment's colour can show.
COLOURINGS = ("strain", "rg", "contact")
#: Distance from the body [m] where the scale of contact begins; it ends at the skin.
_APART = 0.02
#: Powers of ten from one end of a logarithmic scale to the other.
_DECADES = 4


@dataclass(frozen=True)
class Colouring:
    """Values (T, V) with the range that the colours span, one for all frames; ``low`` may be the greater of its ends."""

    values: np.ndarray
    low: float
    high: float
    logarithmic: bool
    title: str
    ticks: tuple[tuple[float, str], ...]  # values and their labels

    def colours(self, frame: int) -> np.ndarray:
        """(V, 3) in 0..1 of the vertices in ``frame``."""
        return colours_at(self.place(self.values[frame]))

    def with_bar(self, picture: _Picture, size: int | None = None) -> _Picture:
        """A copy of ``picture`` with the bar, its ticks and title along the lower edge, in letters of ``size`` pixels."""
        try:
            from PIL import Image, ImageDraw, ImageFont
        except ImportError as error:
            raise ImportError(f"labels on pictures need Pillow: {install('pictures')}") from error
        height, width = picture.shape[:2]
        size = max(11, height // 40) if size is None else size
        left, right = width // 10, width - width // 10
        bottom = height - size // 2 - size
        top = bottom - max(size // 2, 5)
        marked = picture.copy()
        ramp = 255.0 * colours_at(np.linspace(0.0, 1.0, right - left))
        marked[top:bottom, left:right] = np.broadcast_to(ramp, (bottom - top, right - left, 3)).astype(np.uint8)
        canvas = Image.fromarray(marked)
        draw, font, ink = ImageDraw.Draw(canvas), ImageFont.load_default(size), (60, 62, 66)
        draw.rectangle((left, top, right - 1, bottom - 1), outline=ink)
        draw.text((width / 2, top - 2), self.title, fill=ink, font=font, anchor="mb")
        for value, label in self.ticks:
            at = left + float(self.place(np.array(value))) * (right - left - 1)
            draw.line((at, bottom - 1, at, bottom + 2), fill=ink)
            draw.text((at, bottom + 2), label, fill=ink, font=font, anchor="mt")
        return np.asarray(canvas)

    def place(self, values: np.ndarray) -> np.ndarray:
        """Where values lie on the scale, 0..1; NaN where there is none."""
        if self.logarithmic:
            with np.errstate(divide="ignore"):  # zero lies below every scale
                return np.clip(np.log(values / self.low) / np.log(self.high / self.low), 0.0, 1.0)
        return np.clip((values - self.low) / (self.high - self.low), 0.0, 1.0)


def colours_at(place: np.ndarray) -> np.ndarray:
    """(..., 3) colours in 0..1 of places (...) on a scale, 0..1; grey where there is none."""
    known = np.isfinite(place)
    at = np.where(known, place, 0.0) * (len(_SCALE) - 1)
    channels = [np.interp(at, np.arange(len(_SCALE)), _SCALE[:, channel]) for channel in range(3)]
    return np.where(known[..., None], np.stack(channels, axis=-1), _UNKNOWN)


def colouring_of(data: RolloutData, colour: str, beside: Sequence[RolloutData] = ()) -> Colouring | None:
    """The colouring of a rollout by ``strain``, ``rg`` or ``contact``; None for ``none``.

    Args:
        beside: rollouts that are shown next to it: the same colour means the same value in all of them.

    Raises:
        ValueError: an unknown colour, or a rollout that does not hold the values.
    """
    if colour == "none":
        return None
    if colour not in COLOURINGS:
        raise ValueError(f"colour is {colour!r}; choose none, strain, rg or contact")
    if colour == "contact":
        ticks = tuple((share * _APART, f"{1e3 * share * _APART:g} mm") for share in (1.0, 0.5, 0.0))
        return Colouring(skin_distance(data), _APART, 0.0, False, "distance from the body", ticks)
    read = vertex_strain if colour == "strain" else _residual
    values = read(data)
    most = max(_most(values), *(_most(read(other)) for other in beside)) if beside else _most(values)
    if colour == "strain":
        high = _round_up(max(most, 0.01))
        ticks = tuple((share * high, f"{100 * share * high:.3g}%") for share in (0.0, 0.5, 1.0))
        return Colouring(values, 0.0, high, False, "largest strain of the edges around", ticks)
    top = int(np.ceil(np.log10(max(most, 1e-6))))
    ticks = tuple((10.0**power, f"{10.0**power:g}") for power in range(top - _DECADES, top + 1))
    title = "unbalanced force, in units of the weight (g)"
    return Colouring(values, 10.0 ** (top - _DECADES), 10.0**top, True, title, ticks)


def _residual(data: RolloutData) -> np.ndarray:
    if "rg" not in data.fields:
        raise ValueError("colour=rg: the rollout has no cloth/rg; simulate it with metrics={fields:[rg]}")
    return data.fields["rg"].astype(np.float64)


def vertex_strain(data: RolloutData) -> np.ndarray:
    """(T, V) largest absolute relative length change of the edges at every vertex, where the stored mesh is finer those of the
    simulated one; NaN where a frame is not finite."""
    refined = data.refined
    if refined is not None:
        count, faces = refined.num_coarse, np.asarray(refined.faces, dtype=np.int64)
        finer = Subdivision(faces, data.rest_pos[:count], refined.times)
        riders, own_faces = data.riding
        if not np.array_equal(finer.faces, data.cloth_faces[: len(data.cloth_faces) - own_faces]):
            raise ValueError("cloth/faces are not cloth/simulated_faces, refined; simulate it again with hood rollout")
        own = {name: table for name, table in data.still.items() if name == "rest_length"}
        pos, rest = data.cloth_pos[:, :count], data.rest_pos[:count]
        coarse = replace(data, cloth_pos=pos, cloth_faces=faces, rest_pos=rest, still=own)
        spread = finer.spread(vertex_strain(coarse).T).T
        return np.concatenate([spread, np.zeros((len(spread), riders))], axis=1)
    faces = np.asarray(data.cloth_faces, dtype=np.int64)
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    rest = np.linalg.norm(data.rest_pos[edges[:, 0]] - data.rest_pos[edges[:, 1]], axis=1).astype(np.float64)
    flat = data.still.get("rest_length", rest[:0])  # edges of what rides on the cloth come after its own
    rest[: len(flat)] = flat
    result = np.zeros(data.cloth_pos.shape[:2])
    for frame, pos in enumerate(data.cloth_pos):
        strain = np.abs(np.linalg.norm(pos[edges[:, 0]] - pos[edges[:, 1]], axis=1) / rest - 1.0)
        with np.errstate(invalid="ignore"):  # frames that are not finite
            for end in (0, 1):
                np.maximum.at(result[frame], edges[:, end], strain)
    return result


def skin_distance(data: RolloutData) -> np.ndarray:
    """(T, V) signed distance [m] of every vertex from the body's surface; NaN where a frame is not finite.

    Raises:
        ValueError: the rollout has no body.
    """
    if not len(data.body_faces):
        raise ValueError("colour=contact: the rollout has no body; choose strain")
    faces = torch.from_numpy(np.asarray(data.body_faces, dtype=np.int64))
    result = np.full(data.cloth_pos.shape[:2], np.nan)
    for frame, (cloth, body) in enumerate(zip(data.cloth_pos, data.body_pos, strict=True)):
        if np.isfinite(cloth).all() and np.isfinite(body).all():
            points, skin = (torch.from_numpy(np.asarray(pos, dtype=np.float64)) for pos in (cloth, body))
            scene = [torch.zeros(count, dtype=torch.int64) for count in (len(points), len(skin), len(faces))]
            result[frame] = search_surface(points, scene[0], skin, faces, scene[1], scene[2]).dist.numpy()
    return result


def _most(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.quantile(finite, _SPANNED)) if len(finite) else 0.0


def _round_up(value: float) -> float:
    """The next of 1, 2, 5, 10, … times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= value * (1 - 1e-9)))
