"""Two frame rates: that of the simulation, and that of the frames that are given."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction


@dataclass(frozen=True)
class OutputRate:
    """How many frames per second are given of how many that are simulated.

    Args:
        fps: [1/s] of the frames that are given.
        simulated_fps: [1/s] of those that are simulated.
    """

    fps: float
    simulated_fps: float

    @property
    def stride(self) -> Fraction:
        """Simulated frames from one that is given to the next; exact for the rates as they are written."""
        return Fraction(repr(float(self.simulated_fps))) / Fraction(repr(float(self.fps)))

    @property
    def whole(self) -> bool:
        """Whether every frame that is given is a simulated one."""
        return self.stride.denominator == 1

    def count(self, num_simulated: int) -> int:
        """How many frames lie within so many simulated ones, the first included."""
        return int((num_simulated - 1) // self.stride) + 1

    def place(self, index: int) -> tuple[int, Fraction]:
        """The simulated frame at or before the given frame ``index``, and the share of the step from there."""
        before = int(index * self.stride // 1)
        return before, index * self.stride - before
