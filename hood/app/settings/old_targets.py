"""Classes that configs and records of earlier versions name as ``_target_``, and where they are today."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig, ListConfig

#: Modules of then and of today.
_MOVED = {
    "hood.assets.measured": "hood.assets.material",
    "hood.dynamics.refine": "hood.steppers.refined",
    "hood.dynamics.simulator": "hood.steppers.network",
    "hood.dynamics.stepper": "hood.steppers.newton",
    "hood.energies.inertia": "hood.energies.mass_points",
    "hood.energies.self_friction": "hood.energies.self_contact",
    "hood.energies.springs": "hood.energies.mass_points",
    "hood.losses.attachment": "hood.energies.mass_points",
    "hood.losses.bending": "hood.energies.bending",
    "hood.losses.collision": "hood.energies.contact",
    "hood.losses.damping": "hood.energies.damping",
    "hood.losses.friction": "hood.energies.friction",
    "hood.losses.gravity": "hood.energies.mass_points",
    "hood.losses.inertia": "hood.energies.mass_points",
    "hood.losses.layer_friction": "hood.energies.self_contact",
    "hood.losses.layer_sides": "hood.energies.self_contact",
    "hood.losses.layers": "hood.energies.self_contact",
    "hood.losses.potential": "hood.energies.potential",
    "hood.losses.stretching": "hood.energies.membrane",
    "hood.losses.weave": "hood.energies.membrane",
    "hood.losses.wind": "hood.energies.wind",
}


def rename_targets(node: Any) -> None:
    """Put the path of today into every ``_target_`` of a config, in place; others stay as they are."""
    if isinstance(node, dict | DictConfig):
        target = node.get("_target_")
        module, _, name = target.rpartition(".") if isinstance(target, str) else ("", "", "")
        if module in _MOVED:
            node["_target_"] = f"{_MOVED[module]}.{name}"
        for key in node:
            _rename_child(node, key)
    elif isinstance(node, list | ListConfig):
        for index in range(len(node)):
            _rename_child(node, index)


def _rename_child(node: Any, key: Any) -> None:
    if isinstance(node, DictConfig | ListConfig) and node._get_node(key) is None:
        return
    child = node[key]
    if isinstance(child, dict | list | DictConfig | ListConfig):
        rename_targets(child)
