"""hood: learned clothing dynamics. One graph network dresses moving bodies (HOOD, CVPR 2023)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hood.dynamics.reference import load_reference_checkpoint

__version__ = "0.1.0"
__all__ = ["__version__", "load_reference_checkpoint"]


def __getattr__(name: str) -> Any:
    """Names are imported when they are asked for: ``import hood`` loads no torch."""
    if name == "load_reference_checkpoint":
        from hood.dynamics.reference import load_reference_checkpoint

        return load_reference_checkpoint
    raise AttributeError(f"module 'hood' has no attribute {name!r}")
