"""Files of other programs are told apart by their names, and each is refused with what to export instead."""

from __future__ import annotations

from pathlib import Path

import pytest

from hood.assets.files.library import locate
from hood.assets.identify import identify
from hood.assets.motion.animated_mesh import body_kind

FOREIGN = ("fbx", "bvh", "dae", "blend", "max", "mb", "ma")


@pytest.mark.parametrize("suffix", [*FOREIGN, "FBX"])
def test_each_names_the_way_out(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"hero.{suffix}"
    path.write_bytes(b"content")
    assert body_kind(path) == "model"  # so that the body's reader looks for it below
    for kind, way in (("garments", "as OBJ or GLB"), ("motions", r"body=hero\.glb"), ("body", r"body=hero\.glb")):
        with pytest.raises(ValueError, match=rf"hero\.{suffix}: .* files are not read; .*{way}"):
            locate(kind, path)
    with pytest.raises(ValueError, match=r"files are not read; .*GLB"):
        identify(str(path))


def test_alembic_comes_in_as_usd(tmp_path: Path) -> None:
    path = tmp_path / "hero.abc"
    path.write_bytes(b"content")
    for kind in ("garments", "motions", "body"):
        with pytest.raises(ValueError, match=r"hero\.abc: Alembic files are not read; .*export USD, .* give hero\.usd"):
            locate(kind, path)


@pytest.mark.parametrize("suffix", ["c3d", "trc"])
def test_markers_are_to_be_fitted(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"walk.{suffix}"
    path.write_bytes(b"content")
    for read in (lambda: locate("motions", path), lambda: identify(str(path))):
        with pytest.raises(ValueError, match=rf"walk\.{suffix}: .* files are not read; fit SMPL to its markers"):
            read()
