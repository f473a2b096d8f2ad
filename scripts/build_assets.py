"""Rebuilds the embedded default assets: python scripts/build_assets.py [body] [garments] [wardrobe] [motions]."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from hood.assets.files.library import DATA_FOLDER

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # tools/ is not installed

PARTS = ("body", "garments", "wardrobe", "motions")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", help=f"any of {', '.join(PARTS)}; all of them by default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=DATA_FOLDER, help="data folder to write to")
    options = parser.parse_args()
    unknown = [part for part in options.parts if part not in PARTS]
    if unknown:
        parser.error(f"unknown part {unknown[0]!r}: choose from {', '.join(PARTS)}")
    parts = options.parts or PARTS
    body_path = options.out / "body" / "default.npz"

    # The builders need packages that the library does not: import only what was asked for.
    if "body" in parts:
        from tools.assets.makehuman import build_body

        print("body:", build_body(body_path, options.seed))
    if "garments" in parts:
        from tools.assets.tailor import build_garments

        print("garments:", build_garments(options.out / "garments", body_path))
    if "wardrobe" in parts:
        from tools.assets.wardrobe import build_wardrobe

        print("wardrobe:", build_wardrobe(options.out / "garments"))
    if "motions" in parts:
        from tools.assets.choreography import write_motions

        print("motions:", write_motions(options.out / "motions", body_path, options.seed))


if __name__ == "__main__":
    main()
