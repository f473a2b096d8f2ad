"""The table of labelled rollouts: its scenes and labels by name, the fast ones, and inputs that are refused.

A label says what a person saw in the pictures of :mod:`tests.verdict.table.pictures`, before any rule judged the rollout:

- ``label``: right, a supervisor would take the shot, or broken. Faults that no view shows are right.
- ``margin``: clear, or near, where two people might differ.
- ``why``: what was seen. ``since``: first frame in which it shows, to within three frames; ``part``: where.
- ``cause``: of what is broken, cloth, or input where the cloth does what it must on a body or motion that came in wrong.
- ``doubts``: what a person would want to be told about the input, in the words of :data:`hood.assets.files.said.KINDS`.
- ``seen``: when, and from where.

``since``, ``part`` and ``cause`` are null for what is right.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.verdict.table import garments, motions, pieces, things
from tests.verdict.table.scene import Scene, run
from tests.verdict.table.scenes_garments import LOOSE, OUTFITS, PARTS, SIZES
from tests.verdict.table.scenes_poses import HARD, OTHER_BODIES, SHAPES, WRONG_MOTIONS
from tests.verdict.table.scenes_second import ALL
from tests.verdict.table.scenes_steppers import FABRICS, RATES, SOFT_CONTACT, STEPPERS
from tests.verdict.table.scenes_third import ALL as THIRD_ALL

_ALL = [
    *STEPPERS,
    *FABRICS,
    *SOFT_CONTACT,
    *RATES,
    *HARD,
    *OTHER_BODIES,
    *SHAPES,
    *WRONG_MOTIONS,
    *SIZES,
    *PARTS,
    *LOOSE,
    *OUTFITS,
]
SCENES: dict[str, Scene] = {scene.name: scene for scene in _ALL}
assert len(SCENES) == len(_ALL), "two scenes of one name"

#: The second table: other scenes, labelled apart from the first ones and from every rule.
SECOND: dict[str, Scene] = {scene.name: scene for scene in ALL}
assert len(SECOND) == len(ALL), "two scenes of one name"
assert not set(SECOND) & set(SCENES), "a name of the first table"

#: The third table, kept back: what strangers bring, labelled apart from both and from every rule.
THIRD: dict[str, Scene] = {scene.name: scene for scene in THIRD_ALL}
assert len(THIRD) == len(THIRD_ALL), "two scenes of one name"
assert not set(THIRD) & (set(SCENES) | set(SECOND)), "a name of an earlier table"


def _labels(file: str) -> dict[str, dict[str, Any]]:
    return dict(json.loads((Path(__file__).parent / file).read_text(encoding="utf-8")))


LABELS, SECOND_LABELS = _labels("labels.json"), _labels("labels_second.json")
THIRD_LABELS = _labels("labels_third.json")

START = ("start=1.5",)
#: Inputs of the kinds of the table that the command refuses, with one sentence; no rollout, no label.
REFUSED: dict[str, Scene] = {
    scene.name: scene
    for scene in (
        Scene("tank_npz_no_rate", "refused", "newton", "tank", motions.without_rate(), 20),
        Scene("skirt_tangled", "refused", "newton", garments.tangled("skirt", -0.45, -0.15), frames=16, keys=("start=1",)),
        Scene("tank_upside_down", "refused", "newton", garments.upside_down("tank"), frames=20, keys=("start=1",)),
        Scene("shorts_on_chest", "refused", "newton", garments.plain("shorts", (0, 0.42, 0)), frames=20, keys=("start=1",)),
        Scene("tshirt_too_low", "refused", "newton", garments.plain("tshirt", (0, -0.45, 0)), frames=20, keys=("start=1",)),
        Scene("tank_inside_body", "refused", "newton", garments.shrunk_inside("tank"), frames=16, keys=("start=1",)),
        Scene("tshirt_sleeves_off", "refused", "newton", garments.sleeves_off(), "walk_brisk", 30, ("start=1",)),
        Scene(
            "longsleeve_twice", "refused", "newton", garments.twice("longsleeve", (0, 0.004, 0.025)), "walk_curve", 14, START
        ),
        Scene("trousers_wrong_leg", "refused", "newton", garments.plain("trousers", (0.17, 0, 0)), "walk_stroll", 12, START),
        Scene("tank_quarter_turn", "refused", "newton", pieces.turned("tank", 90), "walk_stroll", 12, START),
        Scene("tank_far_too_small", "refused", "newton", "tank", "walk_stroll", 12, (*START, "size=0.5")),
        Scene("tshirt_very_low_poly", "refused", "quickstart", garments.plain("tshirt"), "none", 16, (), things.low_poly(0.05)),
        Scene("tshirt_skirt_jacket", "refused", "newton", "[tshirt,skirt,jacket]", "walk_curve", 12, START),
        Scene("skirt_beside", "refused", "newton", garments.plain("skirt", (2.0, 0, 0)), frames=16, keys=("start=1",)),
    )
}

#: The cheapest of many kinds, half of them broken.
FAST = (
    "curtain_row", "tank_mannequin", "tshirt_lying_belly", "dress_3m_up", "trousers_handstand", "cape_pinned",
    "tank_walk_edges", "dress_slim", "trousers_denim", "skirt_disco",
    "spear_through_sheet", "tshirt_walk_untrained_paper", "dress_walk_guess", "armband", "trousers_kicks_newton1",
    "tshirt_jumps_ours", "cape_not_pinned", "tank_soft_contact", "dress_skirt_off", "tshirt_trousers_off",
)  # fmt: skip


def run_named(name: str, folder: Path) -> tuple[dict[str, Any], int]:
    """What :func:`run` returns for a scene of the first or the second table: a name can be sent to another process."""
    return run((SCENES | SECOND)[name], folder)
