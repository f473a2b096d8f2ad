"""Batches of windows of one garment each, in an order that is random and fast to read."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import numpy as np
from torch.utils.data import Sampler

from hood.rollouts.file.dataset import RolloutDataset

#: Frames whose windows are taken together, four chunks of the compact layout: one more chunk is read at their end.
_RUN = 32

#: Numbers of rollouts of one mesh whose files are read at a time.
_Group = list[int]


class RolloutBatches(Sampler[list[int]]):
    """Batches of items of a :class:`hood.RolloutDataset`, for ``DataLoader(data, batch_sampler=…)``.

    All items of a batch are of one garment, with the same faces. Every window comes once an epoch. Files are shuffled, and a
    few of them are read at a time: their windows are cut into runs of 32 frames, the runs are shuffled, and of as many runs as
    there are files the windows. So a file is opened about once an epoch, and a chunk of frames unpacked once.

    Args:
        data: the data set.
        batch_size: items of a batch; the last ones of a garment may have fewer.
        seed: of the order, with the epoch that :meth:`set_epoch` says.
        shuffle: False: the order of the files and their frames.
        drop_last: without batches that have fewer items.
        files: read at a time. More mix better, and the chunks of as many runs should fit into 64 MB.
        workers: ``num_workers`` of the loader: every worker then has files of its own. Another number is right, and slower.

    Raises:
        ValueError: an argument that cannot be used, or a file that is no rollout.
        FileNotFoundError: a file of the data set is gone.

    Examples:
        >>> import hood
        >>> _ = hood.rollout(garment="tank", num_frames=4, video="none", sheet=False, formats=["cloth"], output="outputs/small")
        >>> batches = hood.RolloutBatches(hood.RolloutDataset(["outputs/small"], window=2), batch_size=2, seed=7)
        >>> len(batches), sorted(len(batch) for batch in batches)
        (2, [1, 2])
    """

    def __init__(
        self,
        data: RolloutDataset,
        batch_size: int,
        *,
        seed: int = 0,
        shuffle: bool = True,
        drop_last: bool = False,
        files: int = 8,
        workers: int = 1,
    ) -> None:
        for name, value, least in (
            ("batch_size", batch_size, 1),
            ("files", files, 1),
            ("workers", workers, 0),
            ("seed", seed, 0),
        ):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ValueError(f"{name}={value!r}: give a whole number from {least} on")
        self.batch_size, self.seed, self.shuffle, self.drop_last = batch_size, seed, shuffle, drop_last
        self._data, self._most, self._streams, self._epoch = data, files, max(workers, 1), 0
        self._by_graph: dict[int, list[int]] = defaultdict(list)
        for number, graph in enumerate(data.graphs):
            self._by_graph[graph].append(number)

    def set_epoch(self, epoch: int) -> None:
        """The next iteration is in the order of this epoch; without a call all epochs have the same order."""
        self._epoch = epoch

    def __len__(self) -> int:
        """Batches of the epoch: garments that do not fill their last batch make them differ by a few between epochs."""
        count = 0
        for groups in self._dealt():
            windows: dict[int, int] = defaultdict(int)
            for group in groups:
                windows[self._data.graphs[group[0]]] += sum(len(self._data.windows(number)) for number in group)
            count += sum(self._batches(total) for total in windows.values())
        return count

    def __iter__(self) -> Iterator[list[int]]:
        streams = [self._stream(groups, self._random(place + 1)) for place, groups in enumerate(self._dealt())]
        while streams:  # a loader gives its batches to the workers in turn
            for stream in [*streams]:
                batch = next(stream, None)
                if batch is None:
                    streams.remove(stream)
                else:
                    yield batch

    def _batches(self, windows: int) -> int:
        return windows // self.batch_size if self.drop_last else -(-windows // self.batch_size)

    def _random(self, part: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, self._epoch, part))

    def _order(self, random: np.random.Generator, count: int) -> np.ndarray:
        return random.permutation(count) if self.shuffle else np.arange(count)

    def _dealt(self) -> list[list[_Group]]:
        """The files, in groups of one mesh, dealt out to the workers so that each has about as many windows."""
        random, windows = self._random(0), [0] * self._streams
        streams: list[list[_Group]] = [[] for _ in windows]
        for numbers in self._by_graph.values():
            mine: list[_Group] = [[] for _ in windows]
            for place in self._order(random, len(numbers)):
                least = windows.index(min(windows))
                mine[least].append(numbers[place])
                windows[least] += len(self._data.windows(numbers[place]))
            for stream, own in zip(streams, mine, strict=True):
                stream += [own[at : at + self._most] for at in range(0, len(own), self._most)]
        return [[groups[place] for place in self._order(random, len(groups))] for groups in streams]

    def _stream(self, groups: list[_Group], random: np.random.Generator) -> Iterator[list[int]]:
        """The batches of one worker."""
        left: dict[int, np.ndarray] = defaultdict(lambda: np.zeros(0, dtype=np.int64))
        length = max(1, _RUN // self._data.stride)
        for group in groups:
            graph = self._data.graphs[group[0]]
            windows = [self._data.windows(number) for number in group]
            runs = [np.arange(at, min(at + length, one.stop)) for one in windows for at in range(one.start, one.stop, length)]
            order = self._order(random, len(runs))
            for at in range(0, len(runs), self._most):
                pool = np.concatenate([left[graph], *(runs[place] for place in order[at : at + self._most])])
                pool = pool[self._order(random, len(pool))]
                full = len(pool) // self.batch_size * self.batch_size
                yield from pool[:full].reshape(-1, self.batch_size).tolist()
                left[graph] = pool[full:]
        if not self.drop_last:
            yield from (rest.tolist() for rest in left.values() if len(rest))
