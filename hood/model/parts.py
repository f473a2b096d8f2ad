"""What a model is put together from, by name: feature sets, outputs and networks of hood, and those of plugins.

Groups of plugins are added to feature sets: ``physical+curvature``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from hood import plugins
from hood.model.features import local, physical
from hood.model.features.feature_set import FeatureSet, paper
from hood.model.features.groups import EdgeGroup, NodeGroup
from hood.model.network.model import MeshGraphNet
from hood.model.readout.edges import EdgeOutput
from hood.model.readout.output import AccelerationOutput, GlobalStepOutput, LocalStepOutput, Output, VelocityBaseOutput

#: Groups of plugins, see :mod:`hood.plugins`: classes that take no arguments.
FEATURES = "features"


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
    known = plugins.names(FEATURES)
    if word not in known:
        raise ValueError(
            f"model.features is {name!r}: no installed package has a group {word!r} (known: {', '.join(known) or 'none'})"
        )
    kind = plugins.find(FEATURES, word)
    if not (isinstance(kind, type) and issubclass(kind, NodeGroup | EdgeGroup)):
        raise ValueError(f"plugin {word!r} of hood.{FEATURES}: is {kind!r}; register a class of NodeGroup or EdgeGroup")
    group = kind()
    if group.of == "layer_edges" and not settings.layers:
        raise ValueError(f"model.features is {name!r}: {word!r} is of edges between layers of cloth; give model.layer_radius")
    return group


#: What a model's output may be, beside the outputs of plugins (:mod:`hood.plugins`).
OUTPUTS: dict[str, type[Output]] = {
    "acceleration": AccelerationOutput,
    "velocity_base": VelocityBaseOutput,
    "local_steps": LocalStepOutput,
    "global_steps": GlobalStepOutput,
    "edges": EdgeOutput,
}
#: The network of every model that does not name another one.
MULTILEVEL = "multilevel"
NETWORKS: dict[str, type[MeshGraphNet]] = {MULTILEVEL: MeshGraphNet}


def output_class(name: str) -> type[Output]:
    """The class of an output, ours or a plugin's.

    Raises:
        ValueError: there is none, or what is registered is no such class.
    """
    found: type[Output] = _named("output", name, OUTPUTS, Output)
    return found


def network_class(name: str) -> type[MeshGraphNet]:
    """The class of a network, likewise."""
    found: type[MeshGraphNet] = _named("network", name, NETWORKS, MeshGraphNet)
    return found


def plugins_of(config: Mapping[str, Any]) -> dict[str, str]:
    """What a model takes from plugins, such as ``outputs/bounded``, and the package of each, such as ``my-cloth 1.0``.

    Args:
        config: its arguments of :func:`hood.steppers.network.build_simulator`.
    """
    output, network = config["output"], config.get("network", MULTILEVEL)
    named = [(FEATURES, name) for name in split_name(config["features"])[1]]
    named += [("outputs", output)] if output not in OUTPUTS else []
    named += [("networks", network)] if network not in NETWORKS else []
    return {f"{kind}/{name}": plugins.origin(kind, name) for kind, name in named}


def _named(key: str, name: str, own: Mapping[str, Any], base: type[Any]) -> Any:
    kind = f"{key}s"
    if name in own:
        return own[name]
    if name not in plugins.names(kind):
        raise ValueError(f"model.{key} is {name!r}; choose {' or '.join((*own, *plugins.names(kind)))}")
    found = plugins.find(kind, name)
    if not (isinstance(found, type) and issubclass(found, base)):
        raise ValueError(f"plugin {name!r} of hood.{kind}: is {found!r}; register a class of {base.__name__}")
    return found
