"""A garment's stack of modifiers and its shape keys: what is simulated, where the result stands, what it has switched off."""

from __future__ import annotations

from typing import Any

#: Name of the modifier, and the beginning of the names of shape keys.
CACHE = "hood"
#: Modifiers that move vertices and keep their number: those before the first other one are part of the garment at its start.
_DEFORMING = {
    *("ARMATURE", "CAST", "CORRECTIVE_SMOOTH", "CURVE", "DISPLACE", "HOOK", "LAPLACIANDEFORM", "LAPLACIANSMOOTH", "LATTICE"),
    *("MESH_CACHE", "MESH_DEFORM", "MESHDEFORM", "SHRINKWRAP", "SIMPLE_DEFORM", "SMOOTH", "SURFACE_DEFORM", "WARP", "WAVE"),
    *("UV_PROJECT", "UV_WARP", "VERTEX_WEIGHT_EDIT", "VERTEX_WEIGHT_MIX", "VERTEX_WEIGHT_PROXIMITY", "NORMAL_EDIT"),
    *("WEIGHTED_NORMAL", "DATA_TRANSFER"),
}
#: Names of what shape keys as a result have switched off, kept on the object.
OFF, MUTED = "hood_off", "hood_muted"


def switched_off(garment: Any) -> tuple[list[Any], list[Any]]:
    """Modifiers and shape keys of the garment that its shape keys as a result have switched off."""
    blocks = garment.data.shape_keys.key_blocks if garment.data.shape_keys else {}
    modifiers = [garment.modifiers.get(name) for name in garment.get(OFF, ())]
    keys = [blocks.get(name) for name in garment.get(MUTED, ())]
    return [one for one in modifiers if one is not None], [one for one in keys if one is not None]


def cut_of(garment: Any) -> int:
    """Place in the stack of modifiers before which the garment is what is simulated, and where the cache belongs."""
    for place, modifier in enumerate(garment.modifiers):
        if modifier.name == CACHE and modifier.type == "MESH_CACHE":
            return place
        if modifier.type not in _DEFORMING:
            return place
    return len(garment.modifiers)


def own_keys(garment: Any) -> list[Any]:
    """Shape keys that an earlier bake has made."""
    blocks = garment.data.shape_keys.key_blocks if garment.data.shape_keys else ()
    return [key for key in blocks if key.name.startswith(f"{CACHE}_")]
