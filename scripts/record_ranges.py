"""Records in a model file what it was trained for, from the settings of its training; the weights stay as they are.

    python scripts/record_ranges.py hood/data/weights/quickstart.safetensors experiment=quickstart
    python scripts/record_ranges.py FILE KEY=VALUE …     # the keys of the ``hood train`` that trained it

Model files hold these ranges since training writes them; this is for older ones.
"""

from __future__ import annotations

import sys
from pathlib import Path

from hood.app.settings.compose import load_config
from hood.app.train import make_trainer
from hood.steppers.checkpoint import load_simulator, record_ranges
from hood.steppers.ranges import describe_conditions


def main() -> None:
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    path = Path(sys.argv[1])
    held = load_simulator(path).config
    trained = make_trainer(load_config("train", [*sys.argv[2:], "trainer.workers=0"])).simulator
    if trained.config != held:
        raise SystemExit(f"{path}: holds {held}; these settings train {trained.config}")
    assert trained.trained_for is not None
    record_ranges(path, trained.trained_for)
    print("\n".join([str(path), *(f"  {name}: {value}" for name, value in describe_conditions(trained.trained_for).items())]))


if __name__ == "__main__":
    main()
