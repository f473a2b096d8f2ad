"""``python -P -m hood``: the same as ``hood``. Without ``-P`` Python itself imports from the working folder."""

from hood.cli.main import entry

if __name__ == "__main__":
    entry()
