"""A process that holds one scene worker, prints the worker's id and waits: started by test_slots."""

from __future__ import annotations

import time

from hood.assets.body.load import load_body
from hood.assets.garment.garment import load_garment
from hood.assets.motion.load import load_sequence
from hood.training import prefetch
from hood.training.scenes import SceneSampler


def main() -> None:
    prefetch._WARM_UP = 0
    feed = prefetch.SceneFeed(SceneSampler(load_body(), [load_garment("tank")], [load_sequence("plie")]), workers=1)
    request = prefetch.Request(0, 0, 0, (0,), 2)
    feed.expect(request)
    feed._expected[request].result()
    assert feed._pool is not None
    print(*feed._pool._processes, flush=True)
    time.sleep(600)


if __name__ == "__main__":
    main()
