"""``python scripts/evaluate.py key=value …``: the same as ``hood evaluate``."""

from hood.cli.main import script

if __name__ == "__main__":
    script("evaluate")
