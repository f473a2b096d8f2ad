"""Images that lie over texture coordinates: PNG or JPEG files, handed on as they are, and their pixels."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hood.assets.files.said import install

#: Larger files [bytes] are refused: pages and glTF hold them whole.
_LARGEST = 4_000_000
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

    def pixels(self, most: int | None = None) -> np.ndarray:
        """(H, W, 3) uint8, the top row first; with ``most`` made smaller until no side has more pixels.

        Raises:
            ImportError: Pillow is missing.
            ValueError: the image is damaged.
        """
        try:
            from PIL import Image
        except ImportError as error:
            raise ImportError(f"pixels of images need Pillow: {install('pictures')}") from error
        try:
            with Image.open(io.BytesIO(self.content)) as opened:
                image = opened.convert("RGB")
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise ValueError(f"the {self.kind} image cannot be decoded ({error}); save it again") from error
        if most is not None:
            image.thumbnail((most, most))
        return np.asarray(image)


def read_texture(path: Path) -> Texture:
    """The image in a file; its first bytes say which kind it is, whatever its name.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is neither PNG nor JPEG, or larger than :data:`_LARGEST`.
    """
    if not path.is_file():
        raise FileNotFoundError(f"image {path}: no such file; give a PNG or JPEG image")
    size = path.stat().st_size
    if size > _LARGEST:
        raise ValueError(
            f"image {path}: {size / 1e6:.1f} MB, more than {_LARGEST / 1e6:g}; save it smaller, or as JPEG, which takes less"
        )
    content = path.read_bytes()
    for begin, kind, suffix in _KINDS:
        if content.startswith(begin):
            return Texture(content, kind, suffix)
    raise ValueError(f"image {path}: neither PNG nor JPEG by its first bytes; save it as one of them")
