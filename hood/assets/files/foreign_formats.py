"""File formats that are not read, each with the way to convert it."""

from __future__ import annotations

from pathlib import Path

from hood import plugins

_SCENES = {
    ".usd": "USD", ".usda": "USD", ".usdc": "USD", ".usdz": "USD", ".fbx": "FBX", ".dae": "COLLADA", ".blend": "Blender",
    ".max": "3ds Max", ".mb": "Maya", ".ma": "Maya", ".abc": "Alembic", ".bvh": "BVH", ".c3d": "C3D", ".trc": "TRC",
}  # fmt: skip
#: How each kind of asset gets out of a scene file.
_WAY_OUT = {
    "garments": "export the garment as OBJ or GLB (Blender imports and exports both)",
    "motions": (
        "export the animated character as GLB and pass it as body={stem}.glb, or retarget the motion to SMPL (AMASS .npz)"
    ),
    "body": "export the character with its animation as GLB (Blender imports and exports it) and pass body={stem}.glb",
    "file": "export a garment as OBJ, a character with its animation as GLB (Blender imports and exports both)",
}
#: Plugins' readers of the kind, see :mod:`hood.plugins`.
_READERS = {"garments": ("meshes",), "motions": ("motions",), "body": (), "file": ("meshes", "motions")}
#: Files of markers, which are no skeleton yet.
_MARKERS = (".c3d", ".trc")
_FITTED = "fit SMPL to its markers (MoSh++, SOMA) and give the .npz that comes out"
_BVH_BODY = (
    "retarget it to SMPL (AMASS .npz), or animate a character with it in Blender and export that as GLB: body={stem}.glb"
)


def require_readable(path: Path, kind: str) -> None:
    """Refuse a file of another program's format; ``kind`` is what it is wanted as: garments, motions, body, or any file.

    Raises:
        ValueError: names the file and what to export instead.
    """
    suffix = path.suffix.lower()
    if suffix not in _SCENES or kind not in _WAY_OUT or any(suffix[1:] in plugins.names(group) for group in _READERS[kind]):
        return
    way = _FITTED if suffix in _MARKERS else _BVH_BODY if suffix == ".bvh" and kind != "garments" else _WAY_OUT[kind]
    raise ValueError(f"{path}: {_SCENES[suffix]} files are not read; {way.format(stem=path.stem)}")
