"""What a model is put together from, by name: outputs and networks of hood, and those of plugins."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hood import plugins
from hood.model.features.sets import PLUGINS as FEATURES
from hood.model.features.sets import split_name
from hood.model.network.model import MeshGraphNet
from hood.model.readout.edges import EdgeOutput
from hood.model.readout.output import AccelerationOutput, GlobalStepOutput, LocalStepOutput, Output, VelocityBaseOutput

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
