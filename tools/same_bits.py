"""Whether a change of the code leaves every bit of its results: rollouts and a short training, as SHA-256 of their arrays.

    python -m tools.same_bits before.json            # at the commit before the change
    python -m tools.same_bits after.json before.json # after it: names what differs, and exits with 1

Bits depend on the processor and the libraries: both are to be made on one machine. Everything runs through the command line, in
one thread, so that a change may move any module. Times are left out.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from safetensors.numpy import load_file

#: What a rollout is of.
SCENES = {
    "tank": "garment=tank sequence=walk_proud",
    "tshirt_in_wind": "garment=tshirt sequence=dance_mixed wind=3 gusts=0.2 damping=0.002 material=denim",
    "dress_from_above": "garment=dress sequence=jumps fps=60 settle=paper body_friction={left_wrist:3}",
    "skirt_held": "garment=skirt sequence=walk_proud start=1.0",
    "trousers_in_two_fabrics": "garment=trousers sequence=plie betas=[1.5,-1] size={below_waistband:1.05} "
    "fabrics={below_left_knee:silk}",
    "outfit": "garment=[tank,skirt] sequence=walk_proud",
    "folds_apart": "garment=longsleeve sequence=squats cloth_contact={mode:on,friction:0.3}",
    "jacket_opens": "garment=jacket sequence=walk_proud events=[{frame:4,open:front_zip}]",
}
#: What takes its steps.
METHODS = {
    "network": "stepper=network refine=0 kernels=torch",
    "network_compiled": "stepper=network refine=0 kernels=compiled",
    "network_fused": "stepper=network refine=0 kernels=fused",
    "refined": "stepper=refine refine=5 kernels=torch guard=repair",
    "swept": "stepper=refine refine={goal:4,method:sweeps} kernels=torch",
    "newton_torch": "stepper=newton solver.engine=torch",
    "newton_compiled": "stepper=newton solver.engine=compiled",
    "newton_direct": "stepper=newton solver.linear=direct",
    "guess": "stepper=guess",
}
_ROLLOUT = "num_frames=8 video=none sheet=false allow_unsound=true metrics={fields:[rg]} seed=3"
_TRAINING = "trainer.iterations=20 trainer.statistics_iterations=4 trainer.log_every=5 trainer.workers=0 trainer.kernels=torch"
#: In the names of results that are times [ms], [s], or made of them [1/s].
_TIMES = ("ms_", "seconds", "per_second")


def main(words: list[str]) -> int:
    if not 1 <= len(words) <= 2:
        print(__doc__)
        return 2
    cases = {f"{scene} {method}": ["rollout", *SCENES[scene].split(), *METHODS[method].split(), *_ROLLOUT.split()]
             for scene in SCENES for method in METHODS}  # fmt: skip
    cases["training"] = ["train", *_TRAINING.split()]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = dict(zip(cases, pool.map(_run, cases.values()), strict=True))
    Path(words[0]).write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    for name, result in found.items():
        if "exit" in result:
            print(f"refused: {name}: {result['said']}")
    if len(words) == 1:
        return 0
    before = json.loads(Path(words[1]).read_text(encoding="utf-8"))
    changed = [name for name in sorted({*before, *found}) if before.get(name) != found.get(name)]
    for name in changed:
        old, new = before.get(name, {}), found.get(name, {})
        print(f"{name}: {', '.join(key for key in sorted({*old, *new}) if old.get(key) != new.get(key))}")
    print(f"{len(found) - len(changed)} of {len(found)} the same")
    return 1 if changed else 0


def _run(words: list[str]) -> dict[str, str]:
    """Digests of what a command writes, by array; ``exit`` and ``said``, its code and last line, where it refuses."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-P", "-m", "hood", *words, f"output={folder}/out"]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
        if done.returncode:
            return {"exit": str(done.returncode), "said": done.stderr.strip().splitlines()[-1] if done.stderr else ""}
        out = Path(folder) / "out"
        return _of_rollout(out / "rollout.h5") if (out / "rollout.h5").exists() else _of_training(out)


def _of_rollout(path: Path) -> dict[str, str]:
    digests: dict[str, str] = {}

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and not any(word in name for word in _TIMES):
            digests[name] = _digest(item[()])

    with h5py.File(path) as file:
        file.visititems(visit)
    verdict = json.loads((path.parent / "summary.json").read_text(encoding="utf-8"))
    digests["verdict"] = hashlib.sha256(
        json.dumps([verdict[key] for key in ("sound", "reasons", "doubts")]).encode()
    ).hexdigest()
    return digests


def _of_training(folder: Path) -> dict[str, str]:
    digests = {name: _digest(array) for name, array in load_file(folder / "model.safetensors").items()}
    for number, line in enumerate((folder / "metrics.jsonl").read_text(encoding="utf-8").splitlines()):
        row = {key: value for key, value in json.loads(line).items() if not any(word in key for word in _TIMES)}
        digests[f"metrics {number}"] = hashlib.sha256(json.dumps(row, sort_keys=True).encode()).hexdigest()
    return digests


def _digest(array: np.ndarray) -> str:
    """SHA-256 of an array of any shape, with its type and shape."""
    array = np.ascontiguousarray(array)
    return hashlib.sha256(f"{array.dtype} {array.shape}".encode() + array.tobytes()).hexdigest()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
