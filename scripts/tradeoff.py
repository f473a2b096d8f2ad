"""``python scripts/tradeoff.py key=value …``: the same as ``hood tradeoff``."""

from hood.cli import script

if __name__ == "__main__":
    script("tradeoff")
