"""Frames that hood has written, brought into the caches that Blender reads."""

from __future__ import annotations

from typing import Any

import numpy as np

from . import meshes, point_cache, results, state
from .axes import to_local
from .fault import BakeError
from .lookup import object_named
from .plan import Captured, Plan


class Collector:
    """Brings frames that hood has written into the caches that Blender reads, in the space of the garments."""

    def __init__(self, plan: Plan, captured: Captured, kept: int) -> None:
        self.plan, self.captured, self.samples, self._kept = plan, captured, 0, kept
        self.total = plan.last - plan.first + 1
        self._caches: list[point_cache.GrowingCache] = []
        self._rest: list[np.ndarray] = []  # in the space of the object, for loose vertices

    def collect(self, most: int = 50) -> int:
        """Bring what is new, of all garments alike, and of it at most so many frames; returns the frames that are there."""
        paths = [state.cache_of(self.plan.folder, garment.file) for garment in self.plan.garments]
        headers = [None if path is None else point_cache.read_header(path) for path in paths]
        if any(header is None for header in headers):
            return self.samples
        there = min(header.samples for header in headers if header is not None)
        if there > self.samples:
            last = min(there, self.samples + most)
            if not self._caches:
                self._begin(paths, headers)
            try:
                read = [point_cache.read_samples(path, self.samples, last) for path in paths if path is not None]
            except FileNotFoundError:  # hood is about to put other files in their place
                return self.samples
            for place, samples in enumerate(read):
                self._bring(place, samples)
            self.samples = last
            self._refresh()
        return self.samples

    def collect_all(self) -> None:
        """Bring all that is there."""
        before = -1
        while before != self.samples:
            before = self.samples
            self.collect()

    def _begin(self, paths: list[Any], headers: list[Any]) -> None:
        """Begin the caches of all garments, or of none.

        Raises:
            BakeError: hood has made something else of a garment than was captured, or the garment has changed since.
        """
        made = []
        for garment, mesh, path, header in zip(self.plan.garments, self.captured.exported, paths, headers, strict=True):
            if header.points != len(mesh.pos):
                raise BakeError(
                    f"{garment.object}: hood made {header.points} vertices of {len(mesh.pos)}; its log says why: "
                    "merge vertices by distance, delete inner layers and separate buttons, then bake again",
                    garment.object,
                )
            obj = path.with_suffix(".obj")
            if obj.is_file() and not np.array_equal(meshes.read_obj_faces(obj), mesh.faces):
                raise BakeError(
                    f"{garment.object}: hood has put its vertices into another order (see the log); separate buttons and "
                    "other small parts into objects of their own",
                    garment.object,
                )
            one = object_named(garment.object, garment.uid)
            if len(one.data.vertices) != len(mesh.number_of):
                raise BakeError(
                    f"{garment.object}: has {len(one.data.vertices)} vertices now, {len(mesh.number_of)} when the bake began; "
                    "undo the change, or bake again",
                    garment.object,
                )
            rest = np.empty(3 * len(one.data.vertices), np.float32)
            one.data.vertices.foreach_get("co", rest)
            cache = self.plan.folder / f"{garment.file}.pc2"
            made.append((one, rest.reshape(-1, 3), point_cache.GrowingCache(cache, len(mesh.number_of), self._kept)))
        for one, _, cache in made:
            if not self.plan.keys and not self.plan.estimate:
                results.remove_keys(one)
                results.attach_cache(one, cache.path, self.plan.first)
        self._rest, self._caches = [rest for _, rest, _ in made], [cache for _, _, cache in made]

    def _bring(self, place: int, samples: np.ndarray) -> None:
        mesh, scale, origin = self.captured.exported[place], self.captured.scale, self.captured.origin
        there = mesh.number_of >= 0
        for number, pos in enumerate(samples, self.samples):
            matrix = self.captured.matrices[place][min(number, len(self.captured.matrices[place]) - 1)]
            local = self._rest[place].astype(np.float64)
            local[there] = to_local(pos, matrix, scale, origin)[mesh.number_of[there]]
            self._caches[place].add(local)

    def _refresh(self) -> None:
        if not self.plan.estimate:
            for garment in self.plan.garments:
                results.refresh(object_named(garment.object, garment.uid))

    def key_shapes(self) -> None:
        """Put all frames into shape keys."""
        for garment, cache in zip(self.plan.garments, self._caches, strict=True):
            samples = point_cache.read_samples(cache.path, 0, self.samples)
            results.key_shapes(object_named(garment.object, garment.uid), samples, self.plan.first)
