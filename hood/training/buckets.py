"""Garments by size: a batch holds scenes of similar size, and as many of them as a budget of vertices allows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

#: Templates share a bucket up to this ratio of vertices.
_SPREAD = 1.5


@dataclass(frozen=True)
class Bucket:
    """Templates of similar size and the slots that train them."""

    templates: tuple[int, ...]  # indices into the list of garments
    first: int  # number of its first slot; slots are numbered through
    count: int  # slots, the scenes of one update

    def template(self, place: int, draw: int) -> int:
        """The garment of scene number ``draw`` of slot ``first + place``: they go round, each as often as the others."""
        return self.templates[(place + draw * self.count) % len(self.templates)]


def make_buckets(sizes: Sequence[int], batch_size: int, max_vertices: int | None = None) -> list[Bucket]:
    """Buckets for garments of ``sizes`` vertices, small ones first.

    Without ``max_vertices`` there is one bucket of ``batch_size`` scenes of all garments. With it, a bucket's largest garment
    has at most 1.5 × the vertices of its smallest, and its updates hold the largest multiple of ``batch_size`` scenes that
    stays within ``max_vertices``. Nothing here depends on how many processes share the scenes; a number of processes that
    divides ``batch_size`` divides every bucket.

    Raises:
        ValueError: ``batch_size`` scenes of the largest garment are more than ``max_vertices``.
    """
    if max_vertices is None:
        return [Bucket(tuple(range(len(sizes))), 0, batch_size)]
    if batch_size * max(sizes) > max_vertices:
        raise ValueError(
            f"trainer.max_vertices={max_vertices}: {batch_size} scenes (trainer.batch_size) of the largest garment, "
            f"{max(sizes)} vertices, are {batch_size * max(sizes)}; raise the one or lower the other"
        )
    groups: list[list[int]] = []
    for index in sorted(range(len(sizes)), key=lambda i: (sizes[i], i)):
        if groups and sizes[index] <= _SPREAD * sizes[groups[-1][0]]:
            groups[-1].append(index)
        else:
            groups.append([index])
    buckets: list[Bucket] = []
    for group in groups:
        count = max_vertices // (batch_size * sizes[group[-1]]) * batch_size
        first = buckets[-1].first + buckets[-1].count if buckets else 0
        buckets.append(Bucket(tuple(sorted(group)), first, count))
    return buckets


def next_bucket(buckets: Sequence[Bucket], turns: Sequence[int]) -> int:
    """Whose update is next after ``turns`` updates of each: they take turns in proportion to their numbers of templates.

    An update's loss is the mean over its own scenes, so every template has the same weight in the expected gradient,
    whatever its size. The scenes behind that mean are fewer for large garments: their share of it is noisier.
    """
    return min(range(len(buckets)), key=lambda k: ((turns[k] + 1) / len(buckets[k].templates), k))
