"""A hood that starts at once, for tests: it reads a bake's files and writes caches frame by frame, as ``formats=[pc2]`` does.

Garments go with the mean of the body. QUICK_SECONDS is how long a frame takes; QUICK_FAULTS the content of ``reasons``. It goes
on after the frames that are there. An interrupt ends it with 130.
"""

from __future__ import annotations

import json
import os
import struct
import sys
import time
from pathlib import Path

import numpy as np


def main(words: list[str]) -> int:
    if words == ["--version"]:
        print("hood 0.1.0 (hood-cloth)")
        return 0
    keys = dict(word.split("=", 1) for word in words[1:])
    if "no_such_key" in keys:
        print("hood: error: no key 'no_such_key'; hood rollout --help lists them")
        return 2
    body = np.load(keys["body"])["verts"]
    each = round(float(keys["fps"]) / float(keys.get("output_fps", keys["fps"])))
    count = (int(keys["num_frames"]) - 1) // each + 1
    place = Path(keys["output"]) / "rollout_pc2"
    place.mkdir(parents=True, exist_ok=True)
    paths = []
    for name in keys["garment"].strip("[]").split(","):
        lines = Path(name).read_text().splitlines()
        pos = np.array([[float(x) for x in line.split()[1:]] for line in lines if line.startswith("v ")])
        paths.append((place / f"{Path(name).stem}.pc2", pos))
        (place / f"{Path(name).stem}.obj").write_text("\n".join(lines))
        if not paths[-1][0].exists():
            paths[-1][0].write_bytes(struct.pack("<12siiffi", b"POINTCACHE2\0", 1, len(pos), 0.0, 1.0, 0))
    first = struct.unpack("<i", paths[0][0].read_bytes()[28:32])[0]
    print(f"begins with frame {first}", flush=True)
    for frame in range(first, count):
        time.sleep(float(os.environ.get("QUICK_SECONDS", "0")))
        moved = body[frame * each].mean(axis=0) - body[0].mean(axis=0)
        for path, pos in paths:
            with open(path, "r+b") as file:
                file.seek(0, 2)
                file.write((pos + moved).astype("<f4").tobytes())
                file.seek(28)
                file.write(struct.pack("<i", frame + 1))
    content = {"ms_per_frame": {"total": {"median": 100.0}}, "reasons": json.loads(os.environ.get("QUICK_FAULTS", "[]"))}
    (place.parent / "summary.json").write_text(json.dumps(content))
    return 3 if content["reasons"] else 0


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit(130)
