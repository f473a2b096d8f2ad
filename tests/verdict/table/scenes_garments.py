"""Scenes of garments that slide, come apart, open, meet each other, lie loosely, or came in wrong."""

from __future__ import annotations

from tests.verdict.table import garments as made
from tests.verdict.table.motions import posed
from tests.verdict.table.scene import Scene

WALK = ("start=1",)
#: Opens everything at frame 6.
OPEN = "events=[{frame: 6, open: %s}]"

SIZES = [
    Scene("trousers_no_pins_large", "slides off", "newton", "trousers", frames=30, keys=(*WALK, "pins=none", "size=1.3")),
    Scene("skirt_no_pins_large", "slides off", "newton", "skirt", frames=30, keys=(*WALK, "pins=none", "size=1.4")),
    Scene("skirt_no_pins", "slides off", "newton", "skirt", frames=36, keys=(*WALK, "pins=none")),
    Scene("shorts_no_pins", "slides off", "quickstart+5", "shorts", frames=30, keys=(*WALK, "pins=none", "size=1.2")),
    Scene("trousers_no_pins_jumps", "slides off", "newton", "trousers", "jumps", 36, ("start=1", "pins=none")),
    Scene("dress_giant", "slides off", "newton", "dress", frames=36, keys=(*WALK, "size=1.6")),
    Scene("tank_giant", "slides off", "newton", "tank", frames=36, keys=(*WALK, "size=1.6")),
    Scene("tshirt_wide", "other sizes", "newton", "tshirt", frames=24, keys=(*WALK, "size=1.2")),
    Scene("longsleeve_wide", "other sizes", "newton", "longsleeve", frames=24, keys=(*WALK, "size=1.3")),
    Scene("skirt_tight", "other sizes", "newton", "skirt", frames=24, keys=(*WALK, "size=0.9")),
    Scene("dress_too_small", "too small", "newton", "dress", frames=20, keys=(*WALK, "size=0.6")),
    Scene("dress_growing", "growing", "newton", "dress", "stand_sway", 36, ("size=0.95", "size_end={size:1.2,seconds:1}")),
    Scene("trousers_growing_off", "growing", "newton", "trousers", "stand_sway", 40,
          ("pins=none", "size=0.9", "size_end={size:1.5,seconds:0.6}")),
]  # fmt: skip

PARTS = [
    Scene("tank_four_panels", "panels that fall apart", "newton", made.panels("tank"), frames=16, keys=WALK),
    Scene("skirt_two_panels", "panels that fall apart", "newton", made.panels("skirt", 2), frames=16, keys=WALK),
    Scene("dress_three_panels_network", "panels that fall apart", "quickstart", made.panels("dress", 3), frames=16, keys=WALK),
    Scene("dress_skirt_off", "detached part", "newton", made.cut_across("dress", 0.10), frames=20, keys=(*WALK, "weld=none")),
    Scene("trousers_leg_ends_off", "detached part", "newton", made.cut_across("trousers", -0.40), frames=20,
          keys=(*WALK, "weld=none")),
    Scene("shirt_buttons", "loose buttons", "newton", made.with_buttons("tshirt"), frames=14, keys=WALK,
          needs="small parts so far from the cloth fall on their own; a loader that fastens them makes it right"),
    Scene("tank_slit_front", "slit garment", "newton", made.slit("tank", 1.0), frames=30, keys=WALK),
    Scene("tank_slit_both", "slit garment", "newton", made.slit("tank", 1.0, side="both"), frames=24, keys=WALK),
    Scene("dress_slit_low", "slit garment", "newton", made.slit("dress", -0.1), "walk_brisk", 24, WALK),
    Scene("tank_skirt_one_file", "two in one file", "newton", made.both("tank", "skirt"), frames=16, keys=WALK,
          needs="the file is one garment of two parts"),
    Scene("tshirt_twice", "tangled start", "newton", made.twice("tshirt"), frames=16, keys=WALK,
          needs="two parts 1 cm apart are taken for one doubled layer"),
    Scene("dress_tangled_network", "tangled start", "quickstart", made.tangled("dress", -0.40, -0.10), frames=16, keys=WALK),
    Scene("skirt_upside_down", "on the wrong way", "newton", made.upside_down("skirt"), frames=24, keys=WALK),
    Scene("tank_beside", "wrong limb", "newton", made.plain("tank", (0.10, 0, 0)), frames=10, keys=WALK,
          needs="the file is put on where it lies"),
]  # fmt: skip

LOOSE = [
    Scene("cape_pinned", "cape", "newton", made.cape, "walk_brisk", 30, ("start=1", "pins={folder}/cape.txt")),
    Scene("cape_wind", "cape", "newton", made.cape, "walk_brisk", 30, ("start=1", "pins={folder}/cape.txt", "wind=[0,0,-6]")),
    Scene("cape_network", "cape", "quickstart", made.cape, "walk_brisk", 24, ("start=1", "pins={folder}/cape.txt")),
    Scene("cape_not_pinned", "slides off", "newton", made.cape, "walk_brisk", 24, WALK),
    Scene("poncho", "poncho", "newton", made.poncho, "walk_brisk", 30, WALK),
    Scene("scarf_walk", "scarf", "newton", made.scarf, "walk_stroll", 24, (*WALK, "settle=paper")),
    Scene("cowl_walk", "scarf", "newton", made.cowl, "walk_brisk", 30, WALK),
    Scene("dropped_sheet", "dropped sheet", "newton", made.dropped(), posed("rest", 0), 30, ("settle=paper",)),
    Scene("dropped_sheet_high", "dropped sheet", "newton", made.dropped(0.4, 0.8), posed("rest", 0), 36, ("settle=paper",)),
    Scene("dropped_sheet_network", "dropped sheet", "quickstart", made.dropped(), posed("rest", 0), 30, ("settle=paper",)),
    Scene("belt_tight", "bare minimum", "newton", made.belt(), "walk_brisk", 24, WALK),
    Scene("belt_loose", "bare minimum", "newton", made.belt(0.24, 0.22), "walk_brisk", 24, WALK),
    Scene("tube_top", "bare minimum", "newton", made.band("tank", 0.18, 0.40), "walk_brisk", 30, WALK),
    Scene("armband", "bare minimum", "newton", made.armband(), "wave_and_reach", 30, WALK),
    Scene("dress_breeze", "wind", "newton", "dress", "walk_stroll", 30, (*WALK, "wind=4")),
    Scene("skirt_storm", "wind", "newton", "skirt", "walk_stroll", 30, (*WALK, "wind=[12,0,0]", "losses.terms.air.gusts=0.2")),
    Scene("tshirt_gale", "wind", "quickstart+5", "tshirt", "walk_stroll", 20, (*WALK, "wind=25")),
    Scene("skirt_blown_up", "wind", "newton", "skirt", "walk_stroll", 20, (*WALK, "wind=[0,14,0]")),
]

OUTFITS = [
    Scene("tank_skirt", "outfit", "newton", "[tank,skirt]", "plie", 20, WALK),
    Scene("tshirt_trousers", "outfit", "quickstart+5", "[tshirt,trousers]", "walk_brisk", 20, WALK),
    Scene("tank_jacket", "outfit", "newton", "[tank,jacket]", "walk_brisk", 16, WALK),
    Scene("tank_skirt_network", "outfit without contact", "quickstart", "[tank,skirt]", "plie", 20, WALK),
    Scene("tshirt_trousers_off", "outfit without contact", "newton", "[tshirt,trousers]", "walk_brisk", 20,
          (*WALK, "cloth_contact=off")),
    Scene("tank_twice_lining", "outfit", "newton", "[tank,tank]", "walk_brisk", 16, WALK),
    Scene("shirt_closed", "buttons and zips", "newton", "shirt", "walk_brisk", 24, WALK),
    Scene("shirt_opened", "buttons and zips", "newton", "shirt", "walk_brisk", 36, (*WALK, OPEN % "front_buttons")),
    Scene("jacket_opened", "buttons and zips", "quickstart+5", "jacket", "twists", 36, (*WALK, OPEN % "front_zip")),
    Scene("jacket_open_wind", "buttons and zips", "newton", "jacket", "walk_stroll", 30,
          (*WALK, "events=[{frame: 2, open: front_zip}]", "wind=5")),
    Scene("jacket_network", "buttons and zips", "quickstart", "jacket", "walk_brisk", 24, WALK),
    Scene("shirt_closing", "buttons and zips", "newton", "shirt", "stand_sway", 36,
          ("events=[{frame: 8, close: front_buttons}]",)),
    Scene("skirt_let_go", "let go by an event", "newton", "skirt", "walk_stroll", 30,
          (*WALK, "events=[{frame: 6, detach: pins}]")),
    Scene("tank_attached", "let go by an event", "newton", "tank", "walk_stroll", 24,
          (*WALK, "events=[{frame: 6, attach: [0,1,2]}]")),
]  # fmt: skip
