"""Which parts of a network are somebody's own: kernels that take it as a whole know the functions of hood's classes alone."""

from __future__ import annotations

from collections.abc import Mapping

from torch import nn

from hood.nn.edge_decoder import EdgeDecoder
from hood.nn.message_passing import ProcessorStep
from hood.nn.mlp import MLP

#: By class what its parts are, alone or in lists and tables.
_CLASSES: Mapping[type[nn.Module], Mapping[str, type[nn.Module]]] = {
    ProcessorStep: {"edge_mlps": MLP, "node_mlp": MLP},
    EdgeDecoder: {"mlp": MLP},
    MLP: {"first": nn.Linear, "second": nn.Linear, "third": nn.Linear, "norm": nn.LayerNorm},
}


def own_part(module: nn.Module, kind: type[nn.Module], parts: Mapping[str, type[nn.Module]] | None = None) -> str:
    """The first part of ``module`` that may compute something else than hood's own would, in words; empty without any.

    Args:
        kind: the class that the module should have, itself and not by inheritance.
        parts: what a module of that class consists of, where it is not known here.
    """
    if _differs(module, kind):
        return _named(module)
    known = _CLASSES.get(kind, {}) if parts is None else parts
    for name, child in module.named_children():
        if name not in known:
            return f"{name}, {_named(child)}"
        found = _listed(child, known[name])
        if found:
            return f"{name}, {found}" if parts is not None else found
    return ""


def _listed(child: nn.Module, kind: type[nn.Module]) -> str:
    """The same of a part, and of all in a list or a table of parts."""
    if type(child) not in (nn.ModuleList, nn.ModuleDict):
        return own_part(child, kind)
    return next((found for part in child.children() if (found := _listed(part, kind))), "")


def _differs(module: nn.Module, kind: type[nn.Module]) -> bool:
    """Whether a module is of another class, has a hook, or a method put in the place of its class' one."""
    replaced = (name for name, value in vars(module).items() if callable(value) and callable(getattr(type(module), name, None)))
    return type(module) is not kind or bool(module._forward_hooks or module._forward_pre_hooks) or any(True for _ in replaced)


def _named(module: nn.Module) -> str:
    return f"{type(module).__module__}.{type(module).__qualname__}"
