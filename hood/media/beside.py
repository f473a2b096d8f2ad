"""Rollouts of one motion next to each other: the same moments, the same camera, one scale of colours for all of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hood.assets.files.said import install
from hood.assets.formats.raw_mesh import Texture
from hood.media.film import Film, seconds_per_frame, sheet_frames
from hood.media.video import VideoWriter
from hood.rollouts.file.reader import RolloutData

_Picture = NDArray[np.uint8]

#: Frames of the contact sheet: it has one row for every rollout.
_SHEET_FRAMES = 6
_INK, _FAINT = (40, 42, 46), (96, 98, 102)
#: Body vertices of one motion, written by two rollouts, lie within this [m] of each other: float32 near and float64 far away.
_SAME_PLACE = 1e-4
_SAME_DT = 1e-6  # relative


@dataclass(frozen=True)
class Panel:
    """One of the rollouts, what is written above it, and the images on its garments in their own colours (as in
    :class:`hood.media.film.Film`)."""

    data: RolloutData
    title: str
    note: str = ""
    textures: Mapping[str, Texture] = field(default_factory=dict)


class SideBySide:
    """Draws the same frame of several rollouts next to each other, in the order given.

    Garments and resolutions may differ, the motion may not. What a colour means stands once, below all of them.

    Args:
        panels: two or more rollouts with as many frames each, see :func:`require_same_motion`.
        colour: ``strain``, ``rg``, or ``none`` for the garments' own colours.
        width, height: pixels of one rollout's picture, titles apart.
        thinner: [m] by which the bodies are drawn thinner near the cloth, as in :class:`hood.media.film.Film`.

    Raises:
        ValueError: fewer than two rollouts, or one that does not hold the values asked for.
    """

    def __init__(
        self, panels: Sequence[Panel], colour: str = "none", width: int = 400, height: int = 560, thinner: float = 0.0
    ) -> None:
        if len(panels) < 2:
            raise ValueError(f"{len(panels)} rollouts cannot be compared; give two or more")
        self.panels, self.width = panels, width
        self._size = max(12, height // 30)
        every = [panel.data for panel in panels]
        self._films = [
            Film(
                panel.data,
                width,
                height,
                colour=colour,
                beside=every[:index] + every[index + 1 :],
                thinner=thinner,
                textures=panel.textures,
            )
            for index, panel in enumerate(panels)
        ]

    @property
    def num_frames(self) -> int:
        return len(self.panels[0].data.cloth_pos)

    def frame(self, index: int) -> _Picture:
        """Picture (H, W, 3) uint8 of frame ``index`` of all rollouts, from left to right."""
        columns = [
            np.concatenate([self._heading(panel, self.width), film.picture(index)])
            for panel, film in zip(self.panels, self._films, strict=True)
        ]
        _divide(columns)
        return self._with_bar(np.concatenate(columns, axis=1))

    def sheet(self, count: int = _SHEET_FRAMES) -> _Picture:
        """``count`` evenly spaced moments from left to right, a row for every rollout."""
        # The start has no unbalanced force: it would be a grey column.
        first = int(self.num_frames > 1 and all(self._is_grey(film) for film in self._films))
        chosen = [first + i for i in sheet_frames(self.num_frames - first, count)]
        rows = []
        for panel, film in zip(self.panels, self._films, strict=True):
            cells = [_write(film.picture(i), [(f"{panel.data.time[i]:.2f} s", _FAINT)], self._size) for i in chosen]
            rows += [self._heading(panel, self.width * len(chosen)), np.concatenate(cells, axis=1)]
        return self._with_bar(np.concatenate(rows))

    @staticmethod
    def _is_grey(film: Film) -> bool:
        """Whether the first frame has no values to be coloured by."""
        return film.colouring is not None and not np.isfinite(film.colouring.values[0]).any()

    def _heading(self, panel: Panel, width: int) -> _Picture:
        size = self._size
        lines = [(panel.title, _INK), (panel.note, _FAINT)] if any(p.note for p in self.panels) else [(panel.title, _INK)]
        return _write(_blank(len(lines) * (size + size // 3) + size // 2, width), lines, size)

    def _with_bar(self, picture: _Picture) -> _Picture:
        """The picture with the scale of colours below it; itself where garments have their own colours."""
        colouring = self._films[0].colouring
        if colouring is None:
            return picture
        strip = _blank(5 * self._size, picture.shape[1])
        return np.concatenate([picture, colouring.with_bar(strip, self._size)])


def require_same_motion(rollouts: Sequence[tuple[str, RolloutData]], num_frames: int | None = None) -> list[RolloutData]:
    """The rollouts, each given with its name, cut to ``num_frames``: the same number of frames of the same body motion.

    Raises:
        ValueError: their frames do not show the same moments of the same motion; names both and the fix.
    """
    name, first = rollouts[0]
    shortest = min(len(data.time) for _, data in rollouts)
    for other_name, other in rollouts[1:]:
        pair, steps = f"{name} and {other_name}", (seconds_per_frame(first), seconds_per_frame(other))
        if min(len(first.time), len(other.time)) > 1 and abs(steps[0] / steps[1] - 1.0) > _SAME_DT:
            raise ValueError(
                f"{pair}: {1 / steps[0]:g} and {1 / steps[1]:g} frames per second show different moments; simulate with one fps"
            )
        if num_frames is None and len(other.time) != len(first.time):
            raise ValueError(
                f"{pair}: {len(first.time)} and {len(other.time)} frames; show those that all have with num_frames={shortest}"
            )
        _require_same_body(pair, first, other)
    count = shortest if num_frames is None else num_frames
    if not 1 <= count <= shortest:
        raise ValueError(f"num_frames={count}: these rollouts have 1 to {shortest} frames in common")
    return [_first_frames(data, count) for _, data in rollouts]


def write_beside(view: SideBySide, path: Path, frames: Iterable[int] | None = None, stride: int = 1) -> Path:
    """Video at the rollouts' own speed, every ``stride``-th frame, or ``frames``. Returns the file written."""
    step = seconds_per_frame(view.panels[0].data)
    with VideoWriter(path, fps=1.0 / (step * stride)) as writer:
        for index in range(0, view.num_frames, stride) if frames is None else frames:
            writer.append(view.frame(index))
    return writer.path


def _require_same_body(pair: str, first: RolloutData, other: RolloutData) -> None:
    sizes = first.body_pos.shape[1], other.body_pos.shape[1]
    if sizes[0] != sizes[1] or not np.array_equal(first.body_faces, other.body_faces):
        raise ValueError(
            f"{pair}: the bodies are different ones, with {sizes[0]} and {sizes[1]} vertices; simulate with the same body"
        )
    count = min(len(first.time), len(other.time))
    apart = np.abs(first.body_pos[:count].astype(np.float64) - other.body_pos[:count]).max(axis=(1, 2), initial=0.0)
    # Far from the origin one of the files may hold float32.
    allowed = _SAME_PLACE + 4 * np.finfo(np.float32).eps * np.abs(first.body_pos[:count]).max(initial=0.0)
    if not (apart <= allowed).all():
        frame = int(np.argmax(~(apart <= allowed)))
        raise ValueError(
            f"{pair}: the bodies move differently, {apart[frame]:.3g} m apart in frame {frame}; simulate with the same "
            "sequence, body, betas and start"
        )


def _first_frames(data: RolloutData, count: int) -> RolloutData:
    return RolloutData(
        cloth_pos=data.cloth_pos[:count],
        cloth_faces=data.cloth_faces,
        rest_pos=data.rest_pos,
        body_pos=data.body_pos[:count],
        body_faces=data.body_faces,
        time=data.time[:count],
        metrics={name: values[:count] for name, values in data.metrics.items()},
        attributes=data.attributes,
        fields={name: values[:count] for name, values in data.fields.items()},
        still=data.still,
    )


def _blank(height: int, width: int) -> _Picture:
    return np.full((height, width, 3), 255, dtype=np.uint8)


def _divide(columns: Sequence[_Picture]) -> None:
    """A white line between pictures that stand side by side."""
    for column in columns[1:]:
        column[:, :2] = 255


def _write(picture: _Picture, lines: Sequence[tuple[str, tuple[int, int, int]]], size: int) -> _Picture:
    """The picture with lines of text in its upper left corner, shortened in the middle where they are too long."""
    try:
        from PIL import Image, ImageDraw, ImageFont
    except ImportError as error:
        raise ImportError(f"labels on pictures need Pillow: {install('pictures')}") from error
    canvas = Image.fromarray(picture)
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(size)
    for row, (text, ink) in enumerate(lines):
        shown, kept = text, len(text)
        while draw.textlength(shown, font=font) > picture.shape[1] - size and kept > 4:
            kept -= 1
            shown = text[: kept // 2] + "..." + text[-(kept - kept // 2) :]
        draw.text((size // 2, size // 3 + row * (size + size // 3)), shown, fill=ink, font=font)
    return np.asarray(canvas)
