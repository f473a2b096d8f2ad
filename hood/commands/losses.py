"""The potential of a config's losses: built once for every content, since a command asks for it many times."""

from __future__ import annotations

import json
from typing import Any

from omegaconf import DictConfig

from hood.config import build, plain
from hood.losses.potential import Potential

#: Contents that are remembered: a plan tries a few others beside the command's own.
_REMEMBERED = 32
_KNOWN: dict[str, Potential] = {}


def losses_of(config: DictConfig) -> Potential:
    """The energies that ``config.losses`` names. Terms of this package hold nothing but settings, and are shared by potentials
    of the same content; those of other packages are made anew each time.

    Raises:
        ConfigError, ValueError: as for :func:`hood.config.build`.
    """
    content = plain(config.losses)
    if not _own(content):
        potential: Potential = build(config.losses)
        return potential
    text = json.dumps(content)
    if text not in _KNOWN:
        _KNOWN[text] = build(config.losses)
        if len(_KNOWN) > _REMEMBERED:
            del _KNOWN[next(iter(_KNOWN))]
    return Potential(_KNOWN[text].terms)


def _own(content: Any) -> bool:
    """Whether all that is to be built is of this package."""
    if not isinstance(content, dict) or not isinstance(content.get("terms"), dict):
        return False
    nodes = [content, *(term for term in content["terms"].values() if term is not None)]
    return all(isinstance(node, dict) and str(node.get("_target_")).startswith("hood.losses.") for node in nodes)
