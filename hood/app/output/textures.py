"""``texture=``: images on the garments of rollouts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from hood.app.settings.compose import ConfigError, plain
from hood.assets.files.library import unknown
from hood.assets.formats.image import Texture, read_texture
from hood.assets.garment.garment import Garment
from hood.media.pieces import GarmentPiece, pieces_by, pieces_of, plain_name
from hood.rollouts.file.reader import RolloutData
from hood.rollouts.file.recorder import still_of

#: The one image of all garments.
_EVERY = ""


def read_textures(config: DictConfig) -> dict[str, Texture]:
    """The images that ``config.texture`` names, by garment; empty where it names none.

    Raises:
        ConfigError: it is neither a file nor a table of garments and files.
        FileNotFoundError: a file is not there.
        ValueError: a file is no image that can be used.
    """
    value = plain(config.texture)
    if value is None:
        return {}
    table = value if isinstance(value, dict) else {_EVERY: value}
    if not table or not all(isinstance(file, str) and file for file in table.values()):
        raise ConfigError(
            f"texture={value}: give an image, texture=plaid.png, or one a garment, texture={{tank:a.png,skirt:b.png}}"
        )
    return {str(name): read_texture(Path(file).expanduser()) for name, file in table.items()}


def lay_on(textures: Mapping[str, Texture], rollouts: Sequence[RolloutData]) -> list[dict[str, Texture]]:
    """Of every rollout the images of its garments, by the names of :func:`hood.media.pieces.pieces_of`.

    Args:
        textures: of :func:`read_textures`.

    Raises:
        ValueError: no rollout has such a garment, or it has no texture coordinates.
    """
    return _laid_on_all(textures, [pieces_of(data) for data in rollouts])


def check_worn(textures: Mapping[str, Texture], garment: Garment) -> None:
    """Refuse images that :func:`lay_on` would refuse for a rollout of ``garment``, before it is made.

    Raises:
        ValueError: see there.
    """
    _laid_on_all(textures, [pieces_by(garment.name, len(garment.rest_pos), garment.faces, still_of(garment))])


def _laid_on_all(textures: Mapping[str, Texture], worn: Sequence[Sequence[GarmentPiece]]) -> list[dict[str, Texture]]:
    names = list(dict.fromkeys(piece.name for pieces in worn for piece in pieces))
    for name in textures:
        if name != _EVERY and plain_name(name) not in names:
            raise ValueError(f"texture: {unknown('garment', name, names)}")
    asked = {name if name == _EVERY else plain_name(name): texture for name, texture in textures.items()}
    return [_laid_on(asked, pieces) for pieces in worn]


def _laid_on(textures: Mapping[str, Texture], pieces: Sequence[GarmentPiece]) -> dict[str, Texture]:
    found = {}
    for piece in pieces:
        texture: Any = textures.get(piece.name, textures.get(_EVERY))
        if texture is None:
            continue
        if not piece.is_mapped:
            raise ValueError(
                f"texture: garment {piece.name!r} has no texture coordinates; "
                "unwrap it where it was made, save it with them, and simulate it again"
            )
        found[piece.name] = texture
    return found
