"""``python scripts/rollout.py key=value …``: the same as ``hood rollout``."""

from hood.cli.main import script

if __name__ == "__main__":
    script("rollout")
