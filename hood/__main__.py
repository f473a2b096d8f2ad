"""``python -P -m hood``: the same as ``hood``. Without ``-P`` Python itself imports from the working folder."""

from hood.assets.files.said import listen
from hood.cli.main import aloud, entry

if __name__ == "__main__":
    entry()
elif __name__ == "__mp_main__":  # a process that a command has spawned
    listen(aloud)
