"""Scenes of ordinary clothes on ordinary motions, by every stepper, and of fabrics, rates and resolutions."""

from __future__ import annotations

from tests.verdict.table.garments import plain
from tests.verdict.table.motions import posed
from tests.verdict.table.scene import Scene

WALK = ("start=1",)

STEPPERS = [
    Scene("dress_dance", "dance", "newton", "dress", "dance_mixed", 30, ("start=2",)),
    Scene("skirt_disco", "dance", "quickstart+5", "skirt", "dance_disco", 30, ("start=2",)),
    Scene("tshirt_disco_network", "dance", "quickstart", "tshirt", "dance_disco", 30, ("start=2",)),
    Scene("tshirt_walk_network", "network alone", "quickstart", "tshirt", frames=30, keys=WALK),
    Scene("dress_walk_network", "network alone", "quickstart", "dress", frames=30, keys=WALK),
    Scene("trousers_walk_network", "network alone", "quickstart", "trousers", frames=30, keys=WALK),
    Scene("longsleeve_walk_network", "network alone", "quickstart", "longsleeve", frames=30, keys=WALK),
    Scene("skirt_walk_network", "network alone", "quickstart", "skirt", frames=30, keys=WALK),
    Scene("tank_walk_edges", "network alone", "edges", "tank", frames=30, keys=WALK),
    Scene("dress_dance_edges", "network alone", "edges", "dress", "dance_mixed", 30, ("start=2",)),
    Scene("longsleeve_lunges_edges", "network alone", "edges", "longsleeve", "lunges", 30, ("start=2",)),
    Scene("tank_walk_ours", "paper network", "ours", "tank", frames=30, keys=WALK),
    Scene("dress_walk_ours", "paper network", "ours", "dress", frames=30, keys=WALK),
    Scene("tshirt_jumps_ours", "paper network", "ours", "tshirt", "jumps", 30, ("start=1",)),
    Scene("tank_walk_fine15", "paper network", "fine15", "tank", frames=30, keys=WALK),
    Scene("skirt_dance_fine48", "paper network", "fine48", "skirt", "dance_mixed", 24, ("start=2",)),
    Scene("dress_walk_small", "small network", "small1", "dress", frames=30, keys=WALK),
    Scene("tshirt_kicks_small", "small network", "small1", "tshirt", "kicks", 30, ("start=1",)),
    Scene("dress_walk_untrained", "untrained network", "untrained_small", "dress", frames=16, keys=WALK),
    Scene("tank_walk_blocks", "untrained network", "untrained_blocks", "tank", frames=16, keys=WALK),
    Scene("tank_walk_global", "untrained network", "untrained_global", "tank", frames=16, keys=WALK),
    Scene("tshirt_walk_untrained_paper", "untrained network", "untrained_paper", "tshirt", frames=16, keys=WALK),
    Scene("dress_walk_refined", "refined network", "quickstart+5", "dress", frames=30, keys=WALK),
    Scene("longsleeve_wave_refined", "refined network", "quickstart+5", "longsleeve", "wave_and_reach", 30, ("start=1",)),
    Scene("trousers_kicks_ours5", "refined network", "ours+5", "trousers", "kicks", 30, ("start=1",)),
    Scene("tshirt_jog_edges5", "refined network", "edges+5", "tshirt", "jog", 30, ("start=1",)),
    Scene("tshirt_jumps_refine1", "one iteration", "quickstart+1", "tshirt", "jumps", 30, ("start=1",)),
    Scene("longsleeve_dance_refine1", "one iteration", "quickstart+1", "longsleeve", "dance_disco", 30, ("start=2",)),
    Scene("skirt_kicks_refine1", "one iteration", "quickstart+1", "skirt", "kicks", 30, ("start=1",)),
    Scene("dress_spin_guess1", "one iteration", "guess+1", "dress", posed("spin", 1.5), 30),
    Scene("trousers_kicks_newton1", "one iteration", "newton_1", "trousers", "kicks", 30, ("start=1",)),
    Scene("dress_walk_newton1", "one iteration", "newton_1", "dress", frames=30, keys=WALK),
    Scene("tank_walk_newton3", "one iteration", "newton_3", "tank", frames=30, keys=WALK),
    Scene("dress_walk_guess", "guess alone", "guess", "dress", frames=12, keys=WALK),
    Scene("tank_stand_guess", "guess alone", "guess", "tank", "stand_sway", 12),
    Scene("dress_jog_guess5", "guess refined", "guess+5", "dress", "jog", 30, ("start=1",)),
    Scene("trousers_walk_guess5", "guess refined", "guess+5", "trousers", frames=30, keys=WALK),
    Scene("tshirt_walk_sweeps", "vertex sweeps", "sweeps+5", "tshirt", frames=24, keys=WALK),
    Scene("skirt_jumps_sweeps", "vertex sweeps", "sweeps+40", "skirt", "jumps", 24, ("start=1",)),
    Scene("tank_plie_direct", "direct solver", "newton_direct", "tank", "plie", 24, ("start=1",)),
]

FABRICS = [
    Scene("dress_silk", "soft fabric", "newton", "dress", "walk_brisk", 30, ("start=1", "material=silk_habotai", "wind=null")),
    Scene("skirt_chiffon", "soft fabric", "newton", "skirt", "twists", 30, ("start=1", "material=chiffon", "wind=null")),
    Scene("tshirt_jersey_network", "soft fabric", "quickstart+5", "tshirt", "bends", 24, ("start=1", "material=jersey")),
    Scene("trousers_denim", "stiff fabric", "newton", "trousers", "squats", 24,
          ("start=1", "material=denim_12oz", "wind=null")),
    Scene("skirt_leather", "stiff fabric", "newton", "skirt", "walk_brisk", 24,
          ("start=1", "material=nappa_leather", "wind=null")),
    Scene("shorts_felt", "stiff fabric", "newton", "shorts", "kicks", 24, ("start=1", "material=wool_felt", "wind=null")),
    Scene("dress_canvas_refined", "stiff fabric", "guess+5", "dress", "dance_slow", 24,
          ("start=1", "material=cotton_canvas", "wind=null")),
    Scene("dress_two_fabrics", "several fabrics", "newton", "dress", "walk_brisk", 24,
          ("start=1", "fabrics={below_waistband:silk}", "material=denim")),
    Scene("dress_like_gum", "over-stretched", "newton", "dress", "jumps", 30,
          ("start=1", "material.lame_mu=250", "material.lame_lambda=400")),
    Scene("trousers_like_gum", "over-stretched", "newton", "trousers", "walk_brisk", 24,
          ("start=1", "material.lame_mu=60", "material.lame_lambda=100")),
    Scene("tshirt_like_dough", "over-stretched", "guess+5", "tshirt", "jumps", 24,
          ("start=1", "material.lame_mu=30", "material.lame_lambda=50")),
    Scene("skirt_of_lead", "no cloth like that", "newton", "skirt", frames=20, keys=(*WALK, "material.density=2000")),
    Scene("tank_of_lead_sheet", "no cloth like that", "newton", "tank", frames=20, keys=(*WALK, "material.density=20")),
    Scene("dress_of_plate", "no cloth like that", "newton", "dress", frames=20,
          keys=(*WALK, "material.bending_stiffness=0.5", "material.lame_mu=5e6", "material.lame_lambda=5e6")),
    Scene("dress_silk_network", "network out of range", "quickstart", "dress", "jumps", 30,
          ("start=1", "material.density=0.02", "material.lame_mu=2000", "material.lame_lambda=2000")),
    Scene("trousers_heavy_ours", "network out of range", "ours", "trousers", frames=24, keys=(*WALK, "material.density=1.5")),
    Scene("dress_120_network", "network out of range", "quickstart", "dress", "walk_brisk", 40, ("start=1", "fps=120")),
    Scene("tshirt_10_network", "network out of range", "quickstart", "tshirt", "jog", 16, ("start=1", "fps=10")),
]  # fmt: skip

#: Contact that gives way, or acts at vertices alone and on the skin itself.
SOFT_CONTACT = [
    Scene("tank_soft_contact", "skin through cloth", "newton", "tank", "walk_brisk", 16,
          ("start=1", "losses.terms.collision.weight=20")),
    Scene("trousers_no_contact", "skin through cloth", "newton", "trousers", "squats", 20,
          ("start=1", "losses.terms.collision.weight=1")),
    Scene("longsleeve_constant_reach", "skin through cloth", "newton", "longsleeve", "walk_brisk", 16,
          ("start=1", "losses.terms.collision.reach=constant")),
    Scene("tshirt_reference_losses", "skin through cloth", "guess+5", "tshirt", "jog", 16, ("start=1", "losses=reference")),
]  # fmt: skip

RATES = [
    Scene("dress_15", "15 frames a second", "newton", "dress", "walk_brisk", 20, ("start=1", "fps=15")),
    Scene("trousers_15_jog", "15 frames a second", "quickstart+5", "trousers", "jog", 16, ("start=1", "fps=15")),
    Scene("skirt_60", "60 frames a second", "newton", "skirt", "dance_disco", 40, ("start=2", "fps=60")),
    Scene(
        "tshirt_120_stored_24", "120 frames a second", "newton", "tshirt", "kicks", 40, ("start=1", "fps=120", "output_fps=24")
    ),
    Scene("dress_12k", "12,000 vertices", "newton", "dress_12k", "walk_brisk", 8, WALK),
    Scene("tshirt_4k", "4,000 vertices", "quickstart+5", "tshirt_4k", "wave_and_reach", 10, WALK),
    Scene("trousers_4k", "4,000 vertices", "newton", "trousers_4k", "lunges", 8, ("start=2",)),
    Scene("tank_plain_file", "a file of one's own", "newton", plain("tank"), frames=20, keys=WALK),
    Scene("dress_plain_file_network", "a file of one's own", "quickstart", plain("dress"), frames=20, keys=WALK),
]
