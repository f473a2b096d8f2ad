"""Feature sets by name, and the groups of plugins that are added to them: ``physical+curvature``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from hood import plugins
from hood.model.features import local, physical
from hood.model.features.feature_set import FeatureSet, paper
from hood.model.features.groups import EdgeGroup, NodeGroup

#: Groups of plugins, see :mod:`hood.plugins`: classes that take no arguments.
PLUGINS = "features"


@dataclass(frozen=True)
class SetSettings:
    """What a model says about its features.

    Args:
        num_levels: told apart by the level feature, the mesh included.
        layers: with edges between layers of cloth.
        together: with what all vertices together would do (``local``).
        of_edges: and what that would make of edges.
        body_velocity, decay, divisor_floor: of ``paper``, see :func:`hood.model.features.paper`.
    """

    num_levels: int
    layers: bool = False
    together: bool = False
    of_edges: bool = False
    body_velocity: str = "previous"
    decay: float = 0.999
    divisor_floor: float | None = None


Groups = list[NodeGroup | EdgeGroup]


def _paper(of: SetSettings, more: Groups) -> FeatureSet:
    return paper(of.num_levels, of.body_velocity, of.decay, of.divisor_floor, of.layers, more)


def _physical(of: SetSettings, more: Groups) -> FeatureSet:
    return physical.physical(of.num_levels, layers=of.layers, more=more)


def _local(of: SetSettings, more: Groups) -> FeatureSet:
    return local.local(of.num_levels, of.layers, of.together, more, of.of_edges)


SETS: dict[str, Callable[[SetSettings, Groups], FeatureSet]] = {"paper": _paper, "physical": _physical, "local": _local}


def split_name(name: str) -> tuple[str, list[str]]:
    """The set and the groups that a text names: ``physical+curvature`` is physical with curvature."""
    first, *more = str(name).split("+")
    return first, more


def build_features(name: str, settings: SetSettings) -> FeatureSet:
    """The set that a text names, with the groups of plugins that it names.

    Raises:
        ValueError: no such set or group; names the known ones.
    """
    first, more = split_name(name)
    if first not in SETS:
        raise ValueError(f"model.features is {name!r}; choose {' or '.join(SETS)}")
    return SETS[first](settings, [_group(name, one, settings) for one in more])


def _group(name: str, word: str, settings: SetSettings) -> NodeGroup | EdgeGroup:
    known = plugins.names(PLUGINS)
    if word not in known:
        raise ValueError(
            f"model.features is {name!r}: no installed package has a group {word!r} (known: {', '.join(known) or 'none'})"
        )
    kind = plugins.find(PLUGINS, word)
    if not (isinstance(kind, type) and issubclass(kind, NodeGroup | EdgeGroup)):
        raise ValueError(f"plugin {word!r} of hood.{PLUGINS}: is {kind!r}; register a class of NodeGroup or EdgeGroup")
    group = kind()
    if group.of == "layer_edges" and not settings.layers:
        raise ValueError(f"model.features is {name!r}: {word!r} is of edges between layers of cloth; give model.layer_radius")
    return group
