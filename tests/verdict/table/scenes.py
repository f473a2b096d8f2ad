"""The table of labelled rollouts: all scenes by name, and the fast ones."""

from __future__ import annotations

from tests.verdict.table.scene import Scene
from tests.verdict.table.scenes_garments import LOOSE, OUTFITS, PARTS, SIZES
from tests.verdict.table.scenes_poses import HARD, OTHER_BODIES, SHAPES, WRONG_MOTIONS
from tests.verdict.table.scenes_steppers import FABRICS, RATES, STEPPERS

_ALL = [*STEPPERS, *FABRICS, *RATES, *HARD, *OTHER_BODIES, *SHAPES, *WRONG_MOTIONS, *SIZES, *PARTS, *LOOSE, *OUTFITS]
SCENES: dict[str, Scene] = {scene.name: scene for scene in _ALL}
assert len(SCENES) == len(_ALL), "two scenes of one name"
