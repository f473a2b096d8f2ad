"""``python scripts/train.py key=value …``: the same as ``hood train``."""

from hood.cli.main import script

if __name__ == "__main__":
    script("train")
