"""``fasten=`` of ``hood prepare``: rows of fasteners on a garment of one's own."""

from __future__ import annotations

from typing import Any

import numpy as np
from omegaconf import DictConfig

from hood.assets.garment.contents.fitting import Fitting
from hood.assets.garment.fasteners import ROOM, fasten, with_room
from hood.commands.garments import names_of
from hood.config import ConfigError, plain


def fasten_as_asked(fitting: Fitting, config: DictConfig) -> np.ndarray:
    """Give the garment on its way the rows that the config asks for; the pairs (N, 2) along their edges, in the numbers of the
    file, which nothing joins.

    Raises:
        ConfigError: ``fasten`` is no table of rows, or the garment is one of several.
        ValueError: a row that the garment cannot have; names it.
    """
    fitting.garment, pairs = fasten(fitting.garment, _rows(config))
    return fitting.in_file(pairs)


def give_room(fitting: Fitting, pairs: np.ndarray) -> None:
    """Draw the two sides of the rows of a clean garment, and other ``pairs`` (N, 2) of its file, as far apart as cloth has to
    be; the fitting notes it."""
    present = fitting.vertex_map[pairs]
    rows = [present[(present >= 0).all(axis=1)], *(fitting.garment.fasteners or {}).values()]
    fitting.garment, moved = with_room(fitting.garment, np.concatenate(rows))
    fitting.note("drawn_apart", moved, f"drew {moved} vertices of fasteners apart: pairs are {1e3 * ROOM:g} mm from each other")


def _rows(config: DictConfig) -> dict[str, Any]:
    given = plain(config.fasten)
    if given is None:
        return {}
    if not isinstance(given, dict) or not given:
        raise ConfigError(f"fasten={given}: give rows by name, such as fasten={{front_zip: {{heights: [0.0, 0.55]}}}}")
    if len(names_of(config.garment)) > 1:
        raise ConfigError("fasten=…: prepare the garments one by one, and give hood rollout all of them")
    return given
