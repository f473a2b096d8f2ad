"""``python scripts/compare.py A.h5 B.h5 key=value …``: the same as ``hood compare``."""

from hood.cli.main import script

if __name__ == "__main__":
    script("compare")
