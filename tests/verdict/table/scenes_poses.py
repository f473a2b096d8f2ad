"""Scenes of hard poses and movements, of bodies that are no persons, of unlikely shapes, and of motions that came in wrong."""

from __future__ import annotations

from tests.verdict.table import bodies, motions
from tests.verdict.table.garments import curtain, level_sheet, plain
from tests.verdict.table.motions import posed
from tests.verdict.table.scene import Scene

HARD = [
    Scene("dress_handstand", "handstand", "newton", "dress", posed("handstand", 180), 36),
    Scene("tshirt_handstand", "handstand", "quickstart+5", "tshirt", posed("handstand", 180), 36),
    Scene("trousers_handstand", "handstand", "newton", "trousers", posed("handstand", 180), 36),
    Scene("trousers_crouch", "crouch", "newton", "trousers", posed("crouch", 110), 23),
    Scene("shorts_crouch", "crouch", "quickstart+5", "shorts", posed("crouch", 110), 34),
    Scene("skirt_deep_crouch", "crouch", "newton", "skirt", posed("crouch", 130), 24),
    Scene("tshirt_crouch", "crouch", "guess+5", "tshirt", posed("crouch", 120), 30),
    Scene("trousers_split", "split", "newton", "trousers", posed("split", 70), 34),
    Scene("skirt_split", "split", "newton", "skirt", posed("split", 75), 34),
    Scene("longsleeve_crossed", "folds of skin", "newton", "longsleeve", posed("crossed", 95), 30),
    Scene("tshirt_arm_through", "folds of skin", "newton", "tshirt", posed("through", 130), 34),
    Scene("tshirt_reach", "reach", "newton", "tshirt", posed("reach", 80), 34),
    Scene("skirt_spin", "spin", "newton", "skirt", posed("spin", 1.5), 34),
    Scene("dress_spin", "spin", "quickstart+5", "dress", posed("spin", 1.0), 34),
    Scene("dress_spin_fast", "spin", "newton", "dress", posed("spin", 3.0), 34),
    Scene("trousers_kicks", "kicks", "quickstart+5", "trousers", "kicks", 36, ("start=1",)),
    Scene("dress_jumps", "jumps", "newton", "dress", "jumps", 36, ("start=1",)),
    Scene("skirt_jumps", "jumps", "quickstart+5", "skirt", "jumps", 36, ("start=1",)),
    Scene("dress_somersault", "somersault", "newton", "dress", motions.flip(0.8, "x"), 26),
    Scene("tshirt_cartwheel", "somersault", "newton", "tshirt", motions.flip(1.0, "y", 0.2), 32),
    Scene("trousers_lying", "lying", "newton", "trousers", motions.lying(), 20, ("up=z",)),
    Scene("tshirt_lying_belly", "lying", "newton", "tshirt", motions.lying(degrees=90), 20, ("up=z",)),
    Scene("skirt_fall", "fall", "newton", "skirt", posed("fall", 2.0, calm=0.1), 30),
    Scene("dress_stop", "sudden stop", "newton", "dress", posed("stop", 2.0), 36),
    Scene("tshirt_stop_hard", "sudden stop", "newton", "tshirt", posed("stop", 30.0), 34),
]

OTHER_BODIES = [
    Scene("tshirt_mesh_body", "mesh body", "newton", bodies.worn_at_first("tshirt"), "none", 20, body=bodies.person()),
    Scene("dress_mesh_folder", "mesh body", "quickstart", bodies.worn_at_first("dress"), "none", 16,
          body=bodies.person(count=16, folder_of=True)),
    Scene("tank_mannequin", "mesh body", "newton", plain("tank"), "none", 16, body=bodies.mannequin),
    Scene("tablecloth", "no person", "newton", level_sheet(0.73), "none", 30, ("settle=paper",), bodies.table),
    Scene("ball_lifts_sheet", "no person", "newton", level_sheet(0.5, 0.8), "none", 12, ("settle=paper",), bodies.ball(1.0)),
    Scene("ball_fast_network", "fast ball", "quickstart", level_sheet(0.5, 0.8), "none", 10,
          ("settle=paper",), bodies.ball(25.0)),
    Scene("ball_fast", "fast ball", "newton", level_sheet(0.5, 0.8), "none", 10,
          ("settle=paper",), bodies.ball(25.0)),
    Scene("spear_through_sheet", "tunnelling", "newton", level_sheet(0.5, 0.8), "none", 12,
          ("settle=paper",), bodies.spear(6.0)),
    Scene("spear_through_sheet_network", "tunnelling", "quickstart", level_sheet(0.5, 0.8), "none", 12,
          ("settle=paper",), bodies.spear(6.0)),
    Scene("sheet_torn_by_rim", "torn", "guess", level_sheet(0.5, 0.8), "none", 14,
          ("settle=paper", "pins={folder}/rim.txt"), bodies.ball(6.0)),
    Scene("curtain_row", "pinned drape", "newton", curtain(), "none", 30, ("pins={folder}/pins.txt",), "none"),
    Scene("curtain_wind", "pinned drape", "newton", curtain(), "none", 30, ("pins={folder}/pins.txt", "wind=[0,0,4]"), "none"),
    Scene("curtain_network", "pinned drape", "quickstart", curtain(), "none", 20, ("pins={folder}/pins.txt",), "none"),
]  # fmt: skip

SHAPES = [
    Scene("dress_slim", "other shapes", "newton", "dress", "walk_brisk", 20, ("start=1", "betas=[-2,1]")),
    Scene("trousers_shop_broad", "other shapes", "newton", "trousers", "walk_brisk", 20, ("start=1", "betas=[2]", "fit=none")),
    Scene("dress_betas_8", "no person's shape", "newton", "dress", "walk_steady", 16, ("start=1", "betas=[8]")),
    Scene("skirt_betas_mixed", "no person's shape", "newton", "skirt", "walk_steady", 16, ("start=1", "betas=[-8,8,-8]")),
]

WRONG_MOTIONS = [
    Scene("dress_head_down", "head down", "newton", "dress", motions.head_down(), 24, ("up=y",)),
    Scene("trousers_head_down_auto", "head down", "newton", "trousers", motions.head_down(), 20,
          needs="up=auto stands the person up"),
    Scene("dress_wrong_axis", "lies by a wrong axis", "newton", "dress", "walk_proud", 20, ("start=1", "up=y")),
    Scene("skirt_y_up", "up axis by the poses", "newton", "skirt", motions.y_up(), 20,
          needs="up=auto finds that y is up"),
    Scene("tshirt_under_floor", "under the floor", "newton", "tshirt", motions.moved(shift=(0, 0, -1.4)), 16),
    Scene("dress_3m_up", "above the floor", "newton", "dress", motions.moved(shift=(0, 0, 3.0)), 16),
    Scene("skirt_20_metres_a_second", "too fast", "newton", "skirt", motions.moved(speed=20.0), 20,
          needs="steps that long are taken for centimetres"),
    Scene("dress_20_network", "too fast", "quickstart", "dress", motions.moved(speed=20.0), 20,
          needs="steps that long are taken for centimetres"),
    Scene("tank_60_metres_a_second", "too fast", "guess+5", "tank", motions.moved(speed=60.0), 14,
          needs="steps that long are taken for centimetres"),
    Scene("tshirt_fast_forward", "too fast", "newton", "tshirt", "dance_disco", 16, ("start=0.6", "file_fps=480")),
    Scene("dress_teleport", "jump of the body", "newton", "dress", motions.moved(jump=2.0, at=24), 24),
    Scene("tshirt_teleport_network", "jump of the body", "quickstart", "tshirt", motions.moved(jump=2.0, at=24), 24),
    Scene("tank_small_jump", "jump of the body", "newton", "tank", motions.moved(jump=0.25, at=24), 24),
    Scene("dress_half_turn", "jump of the body", "newton", "dress", motions.turned_rows(20, 24), 24),
    Scene("tshirt_centimetres", "wrong unit", "guess+5", "tshirt", motions.moved(scale=100.0), 12,
          needs="centimetres are converted"),
    Scene("dress_centimetres_slow", "wrong unit", "quickstart", "dress", motions.moved("stand_sway", 0, scale=100.0), 12,
          needs="centimetres are converted"),
    Scene("tank_no_rate", "no frame rate", "newton", "tank", motions.pose_pickle(every=2), 20),
    Scene("skirt_no_rate_slow", "no frame rate", "quickstart+5", "skirt", motions.pose_pickle("jog"), 20),
    Scene("tshirt_shaken", "noise of a capture", "newton", "tshirt", motions.shaken(0.004, 1.0), 24),
    Scene("dress_badly_shaken", "noise of a capture", "guess+5", "dress", motions.shaken(0.05, 12.0), 14),
]  # fmt: skip
