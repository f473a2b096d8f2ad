"""The results behind a chart of time against accuracy."""

from __future__ import annotations

from dataclasses import dataclass, field

from hood.evaluation.comparison import crossover, verdicts_by_size
from hood.evaluation.grid import Point
from hood.evaluation.reached import Reached


@dataclass
class Study:
    """What was measured, and what is missing.

    Args:
        rejected: settings that overstretch the cloth.
        left_out: points that gave nothing, why, and the file of their log.
        absent: models that would have been measured, had they been there.
    """

    reached: list[Reached]
    rejected: set[Point]
    left_out: list[tuple[Point, str, str]] = field(default_factory=list)
    absent: list[str] = field(default_factory=list)

    @property
    def sizes(self) -> list[str]:
        return list(dict.fromkeys(item.point.size for item in self.reached if item.charted))

    def at(self, size: str) -> list[Reached]:
        return [item for item in self.reached if item.point.size == size]

    @property
    def device(self) -> str:
        """Where it was measured; every device, if there were several."""
        return " and ".join(dict.fromkeys(str(item.record.get("device", "unnamed device")) for item in self.reached))

    @property
    def warning(self) -> str:
        """Whether times can be trusted; empty where they can."""
        ways = {(item.record.get("device"), item.record.get("jobs")) for item in self.reached}
        text = ""
        if len(ways) > 1:
            text = (
                "The settings were not all measured on one machine with equally many side by side: comparisons of time between "
                "them do not hold. "
            )
        disturbed = [item for item in self.reached if item.disturbed]
        if not disturbed:
            return text.rstrip()
        least = min(item.record["cpu_share"] for item in disturbed)
        return text + (
            f"The machine was busy with other work: {len(disturbed)} of {len(self.reached)} settings had their processor for "
            f"only a part of the time (down to {least:.0%}), so times are too long and comparisons of time do not hold. "
            "Measure again on a machine that is free, or with fewer jobs."
        )

    @property
    def sentence(self) -> str:
        """Where a network gives way to the solver alone."""
        return crossover(verdicts_by_size(self.reached, self.rejected), self.device)
