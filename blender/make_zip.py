"""The add-on as one zip that Blender installs (Preferences > Get Extensions > Install from Disk): ``make addon``."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path

SOURCE = Path(__file__).parent / "hood_blender"


def files_of(source: Path = SOURCE) -> list[Path]:
    """What is in the zip, in an order that is always the same."""
    return sorted(path for path in source.iterdir() if path.suffix in (".py", ".toml"))


def make_zip(target: Path) -> Path:
    """Write the zip; the same files give the same bytes."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in files_of():
            entry = zipfile.ZipInfo(path.name, (2020, 1, 1, 0, 0, 0))
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, path.read_bytes())
    return target


if __name__ == "__main__":
    made = make_zip(Path(sys.argv[1] if len(sys.argv) > 1 else "outputs/hood_blender.zip"))
    print(f"{made}: in Blender, Preferences > Get Extensions > Install from Disk")
