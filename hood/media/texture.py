"""Images that are drawn onto garments: PNG or JPEG files, handed on as they are."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path

#: Larger files [bytes] are refused: pages and glTF hold them whole.
LARGEST = 4_000_000
#: How a file begins, its kind and the ending of its name.
_KINDS = ((b"\x89PNG\r\n\x1a\n", "image/png", ".png"), (b"\xff\xd8\xff", "image/jpeg", ".jpg"))


@dataclass(frozen=True)
class Texture:
    """An image file that is laid over texture coordinates: (0, 0) is its lower left corner, (1, 1) its upper right one, and it
    repeats beyond."""

    content: bytes
    kind: str  # image/png or image/jpeg
    suffix: str  # .png or .jpg

    @property
    def address(self) -> str:
        """The image as an address of its own, for pages that load nothing."""
        return f"data:{self.kind};base64,{base64.b64encode(self.content).decode()}"


def read_texture(path: Path) -> Texture:
    """The image in a file; its first bytes say which kind it is, whatever its name.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is neither PNG nor JPEG, or larger than :data:`LARGEST`.
    """
    if not path.is_file():
        raise FileNotFoundError(f"texture {path}: no such file; give a PNG or JPEG image")
    size = path.stat().st_size
    if size > LARGEST:
        raise ValueError(
            f"texture {path}: {size / 1e6:.1f} MB, more than {LARGEST / 1e6:g}; save it smaller, or as JPEG, which takes less"
        )
    content = path.read_bytes()
    for begin, kind, suffix in _KINDS:
        if content.startswith(begin):
            return Texture(content, kind, suffix)
    raise ValueError(f"texture {path}: neither PNG nor JPEG by its first bytes; save it as one of them")
