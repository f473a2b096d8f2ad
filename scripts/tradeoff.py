"""``python scripts/tradeoff.py key=value …``: the same as ``hood tradeoff``."""

from hood.cli.main import script

if __name__ == "__main__":
    script("tradeoff")
