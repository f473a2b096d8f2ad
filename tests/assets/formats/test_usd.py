"""USD stages as garments and bodies: units, axes, places, samples, skeletons, names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hood.assets.formats import usd
from hood.assets.formats.mesh_file import read_mesh_file
from hood.assets.formats.usd import read_usd_animation
from hood.assets.identify import GARMENT, MOVING_MESH, identify
from hood.assets.motion.animated_mesh import body_kind, load_mesh_sequence

pytest.importorskip("pxr", reason="usd-core has no wheel for this machine")
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdSkel, UsdUtils, Vt

#: A box with its corner at 0: of quads that look outwards.
BOX = np.array([[x, y, z] for x in (0.0, 0.4) for y in (0.0, 1.7) for z in (0.0, 0.3)])
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


def stage_at(path: Path, up: str = "Y", unit: float = 1.0) -> Any:
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, up)
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    stage.SetTimeCodesPerSecond(24.0)
    return stage


def add_box(stage: Any, name: str, pos: np.ndarray = BOX, moved: np.ndarray | None = None) -> Any:
    """A mesh; ``moved`` (T, 8, 3) are its points at time codes 1, 2, …"""
    mesh = UsdGeom.Mesh.Define(stage, name)
    mesh.CreateFaceVertexCountsAttr([4] * 6)
    mesh.CreateFaceVertexIndicesAttr(QUADS.reshape(-1).tolist())
    for frame, points in enumerate([pos] if moved is None else moved):
        mesh.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(np.float32(points)), *([] if moved is None else [frame + 1]))
    return mesh


def volume(pos: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (pos[faces[:, corner]] for corner in range(3))
    return float(np.einsum("fi,fi->", a, np.cross(b, c))) / 6.0


@pytest.mark.parametrize("suffix", [".usd", ".usda", ".usdc", ".usdz"])
def test_a_mesh_is_in_metres_with_y_up_and_in_its_place(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / ("coat.usda" if suffix == ".usdz" else f"coat{suffix}")
    stage = stage_at(path, "Z", 0.01)
    place = UsdGeom.Xform.Define(stage, "/world")
    place.AddTranslateOp().Set(Gf.Vec3d(100.0, 0.0, 50.0))
    mesh = add_box(stage, "/world/coat", 100.0 * BOX[:, [0, 2, 1]] * [1, -1, 1])  # as it is with z up, in cm
    texture = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    corner = np.tile([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], (6, 1))
    texture.Set(Vt.Vec2fArray.FromNumpy(np.float32(corner)))
    stage.Save()
    if suffix == ".usdz":
        assert UsdUtils.CreateNewUsdzPackage(str(path), str(tmp_path / "coat.usdz"))
        path = tmp_path / "coat.usdz"
    found = read_mesh_file(path, split_polygons=True)
    np.testing.assert_allclose(found.pos, BOX + [1.0, 0.5, 0.0], atol=1e-6)
    assert volume(found.pos, found.faces) == pytest.approx(0.4 * 1.7 * 0.3, rel=1e-5)
    assert found.num_polygons == 6
    assert found.uv is not None
    assert found.uv_faces is not None
    np.testing.assert_array_equal(found.uv[found.uv_faces[:2]], corner[[[0, 1, 2], [0, 2, 3]]])
    assert identify(str(path)) == GARMENT


def test_left_handed_and_mirrored_meshes_look_outwards(tmp_path: Path) -> None:
    stage = stage_at(tmp_path / "a.usda")
    left = add_box(stage, "/left")
    left.CreateFaceVertexIndicesAttr(QUADS[:, ::-1].reshape(-1).tolist())
    left.CreateOrientationAttr("leftHanded")
    mirrored = add_box(stage, "/mirrored")
    mirrored.AddScaleOp().Set(Gf.Vec3f(-1.0, 1.0, 1.0))
    stage.Save()
    found = read_mesh_file(tmp_path / "a.usda", split_polygons=True)
    for half in (found.faces[:12], found.faces[12:]):
        assert volume(found.pos, half) == pytest.approx(0.4 * 1.7 * 0.3, rel=1e-5)


def test_names_of_prims_materials_and_subsets_choose_a_part(tmp_path: Path) -> None:
    path = tmp_path / "outfit.usda"
    stage = stage_at(path)
    tank, _ = add_box(stage, "/world/tank"), add_box(stage, "/world/skirt", BOX - [0.0, 2.0, 0.0])
    hidden = add_box(stage, "/world/hidden")
    hidden.MakeInvisible()
    add_box(stage, "/world/simple").CreatePurposeAttr(UsdGeom.Tokens.proxy)
    material = UsdShade.Material.Define(stage, "/looks/linen")
    UsdShade.MaterialBindingAPI.Apply(tank.GetPrim()).Bind(material)
    UsdGeom.Subset.CreateGeomSubset(tank, "collar", UsdGeom.Tokens.face, Vt.IntArray([0, 1]))
    stage.Save()
    found = read_mesh_file(path, split_polygons=True)
    assert len(found.pos) == 16
    assert found.panels is not None
    assert {name: int(mask.sum()) for name, mask in found.panels.items()} == {"tank": 12, "linen": 8, "collar": 4, "skirt": 12}
    for name in ("skirt", "/world/skirt"):
        alone = read_usd_animation(path, 30.0, [name])
        np.testing.assert_allclose(alone.verts[0], BOX - [0.0, 2.0, 0.0], atol=1e-6)
    with pytest.raises(ValueError, match=r"outfit\.usda: no part 'hat'; it has skirt, tank"):
        load_mesh_sequence(f"{path}:hat")


def test_a_body_moves_by_its_samples_and_those_of_what_carries_it(tmp_path: Path) -> None:
    """24 time codes a second, sampled at 48 and 24 frames a second; between samples points move linearly."""
    path = tmp_path / "scene.usdc"
    stage = stage_at(path, unit=0.01)
    shift = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 1.0, 0.0]])
    carrier = UsdGeom.Xform.Define(stage, "/carrier").AddTranslateOp()
    for time, height in ((1, 0.0), (3, 10.0)):
        carrier.Set(Gf.Vec3d(0.0, height, 0.0), time)
    add_box(stage, "/carrier/body", moved=100.0 * BOX + shift[:, None])
    add_box(stage, "/cloth", moved=100.0 * BOX + shift[:2, None])
    stage.Save()
    assert body_kind(path) == "mesh"
    assert identify(str(path)) == MOVING_MESH
    along = np.array([[0.0, 0.0, 0.0], [1.0, 2.5, 0.0], [2.0, 5.0, 0.0], [2.0, 8.0, 0.0], [2.0, 11.0, 0.0]]) / 100.0
    for fps, wanted in ((48.0, along), (24.0, along[::2])):
        found = load_mesh_sequence(f"{path}:body", fps)
        assert found.fps == fps
        np.testing.assert_allclose(found.verts, BOX + wanted[:, None], atol=1e-6)
    np.testing.assert_allclose(read_mesh_file(path, True).pos[:8], BOX, atol=1e-6)  # a garment: the first sample


def test_skeletons_are_played(tmp_path: Path) -> None:
    """The upper half follows a joint that moves aside."""
    path = tmp_path / "hero.usda"
    stage = stage_at(path)
    UsdSkel.Root.Define(stage, "/hero")
    mesh, skeleton = add_box(stage, "/hero/skin"), UsdSkel.Skeleton.Define(stage, "/hero/rig")
    joints, still = Vt.TokenArray(["root", "root/chest"]), Vt.Matrix4dArray([Gf.Matrix4d(1.0), Gf.Matrix4d(1.0)])
    skeleton.CreateJointsAttr(joints)
    skeleton.CreateBindTransformsAttr(still)
    skeleton.CreateRestTransformsAttr(still)
    motion = UsdSkel.Animation.Define(stage, "/hero/rig/walk")
    motion.CreateJointsAttr(joints)
    motion.CreateRotationsAttr([Gf.Quatf(1.0)] * 2)
    motion.CreateScalesAttr([Gf.Vec3h(1.0)] * 2)
    for time, aside in ((0.0, 0.0), (24.0, 0.5)):
        motion.CreateTranslationsAttr().Set([Gf.Vec3f(0.0), Gf.Vec3f(aside, 0.0, 0.0)], time)
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([motion.GetPath()])
    binding.CreateJointIndicesPrimvar(False, 1).Set([int(height > 1.0) for height in BOX[:, 1]])
    binding.CreateJointWeightsPrimvar(False, 1).Set([1.0] * 8)
    stage.Save()
    before = path.read_bytes()
    found = load_mesh_sequence(path, 2.0)
    upper = (BOX[:, 1] > 1.0)[:, None] * np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(found.verts, BOX + np.array([0.0, 0.25, 0.5])[:, None, None] * upper, atol=1e-6)
    assert path.read_bytes() == before


def broken(tmp_path: Path, kind: str) -> Path:
    path = tmp_path / "a.usda"
    if kind == "no USD":
        path.write_text("o box\n")
        return path
    stage = stage_at(path)
    if kind == "reference":
        stage.DefinePrim("/hero").GetReferences().AddReference("./lost.usda", "/hero")
    elif kind == "points":
        mesh = add_box(stage, "/box", moved=np.stack([BOX, BOX]))
        mesh.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(np.float32(BOX[:6])), 2)
    elif kind == "corners":
        add_box(stage, "/box").CreateFaceVertexCountsAttr([4] * 5)
    stage.Save()
    return path


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("no USD", "not a readable USD file"),
        ("nothing", "the stage has no visible mesh with faces"),
        ("reference", r"refers to lost\.usda, which cannot be read; put it beside"),
        ("points", "/box has 8 points at first and 6 at time code 2; a body keeps them"),
        ("corners", "/box has 24 corners for polygons of 20; export it again"),
    ],
)
def test_what_cannot_be_read_is_one_sentence(tmp_path: Path, kind: str, said: str) -> None:
    path = broken(tmp_path, kind)
    with pytest.raises(ValueError, match=rf"a\.usda: {said}") as error:
        load_mesh_sequence(path, 24.0)
    assert "\n" not in str(error.value)
    if kind != "points":
        with pytest.raises(ValueError, match=rf"a\.usda: {said}"):
            read_mesh_file(path, True)


def test_without_the_package_the_way_out_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = broken(tmp_path, "nothing")
    monkeypatch.setattr(usd, "has_usd", lambda: False)
    with pytest.raises(
        ValueError, match=r"a\.usda: reading USD needs usd-core, which has no wheel .*; export a garment as OBJ"
    ):
        read_mesh_file(path)
