"""What a bake leaves in Blender lies where hood has simulated it: units, rates, transforms, instances, outfits, shape keys."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import bpy
import characters as made
import h5py
import numpy as np
import pytest
from hood_blender import job

#: Farther from hood's positions [m] no vertex may be.
EXACT = 1e-5


def bake() -> Any:
    """Bake the scene to its end; the job."""
    try:
        bpy.ops.hood.bake(wait=True)
    except RuntimeError:
        pass  # how an operator reports an error to a script; the job keeps it
    return job.job_of(bpy.context.scene.name)


def folder(tmp_path: Path) -> Path:
    return tmp_path / "hood_cache" / "scene"


def simulated(tmp_path: Path) -> np.ndarray:
    """(T, V, 3) m of rollout.h5, z up."""
    with h5py.File(folder(tmp_path) / "run" / "rollout.h5") as file:
        pos = np.asarray(file["cloth/pos"][: int(file.attrs["num_frames"])], np.float64)
    return np.stack([pos[..., 0], -pos[..., 2], pos[..., 1]], axis=-1)


def off(tmp_path: Path, garment: Any, first: int = 1, scale: float = 1.0, start: int = 0) -> float:
    """How far [m] the garment is from hood's positions, in any frame."""
    expected = simulated(tmp_path)
    count = len(garment.data.vertices)
    there = [made.world_at(garment, first + k) * scale for k in range(len(expected))]
    return float(np.abs(np.array(there) - expected[:, start : start + count]).max())


@pytest.mark.parametrize("fps", [24, 25, 30, 60])
def test_any_frame_rate(tmp_path: Path, fps: int) -> None:
    made.fresh(fps, last=4)
    body, _ = made.character(swing=0.02)
    skirt = made.skirt()
    made.wear(body, skirt)
    done = bake()
    assert not done.error, done.error
    with h5py.File(folder(tmp_path) / "run" / "rollout.h5") as file:
        assert file.attrs["dt"] == pytest.approx(1 / fps, rel=1e-12)
    assert simulated(tmp_path).shape[0] == 4
    assert off(tmp_path, skirt) < EXACT
    assert done.progress.seconds_per_frame > 0


def test_a_scene_in_centimetres_an_unapplied_scale_and_a_moving_parent(tmp_path: Path) -> None:
    scene = made.fresh(last=5, scale=0.01)
    body, rig = made.character(unit=100.0)
    skirt = made.skirt(unit=100.0)
    made.turned(skirt)
    skirt.parent = rig
    scene.frame_set(1)
    skirt.matrix_parent_inverse = rig.matrix_world.inverted()
    made.wear(body, skirt)
    done = bake()
    assert not done.error, done.error
    assert off(tmp_path, skirt, scale=0.01) < EXACT
    assert np.ptp(made.world_at(skirt, 1)[:, 2]) == pytest.approx(35.0, rel=0.1)


def test_the_modifier_stands_once_and_before_what_refines_the_cloth(tmp_path: Path) -> None:
    made.fresh(last=3)
    body, rig = made.character()
    skirt = made.skirt()
    skirt.modifiers.new("Armature", "ARMATURE").object = rig
    skirt.modifiers.new("Thick", "SOLIDIFY").thickness = 0.002
    made.wear(body, skirt)
    for _ in range(2):
        assert not bake().error
    assert [modifier.name for modifier in skirt.modifiers] == ["Armature", "hood", "Thick"]
    skirt.modifiers["Thick"].show_viewport = False
    assert off(tmp_path, skirt) < EXACT


def test_a_fast_body_is_captured_and_simulated_twice_a_frame(tmp_path: Path) -> None:
    made.fresh(last=4)
    body, rig = made.character(swing=0.0)
    for frame, x in ((1, 0.0), (4, 0.24)):
        rig.location.x = x
        rig.keyframe_insert("location", frame=frame)
    skirt = made.skirt()
    made.wear(body, skirt)
    assert not bake().error
    captured = np.load(folder(tmp_path) / "capture" / "body.npz")
    assert captured["verts"].shape[0] == 7
    assert captured["fps"] == 48.0
    assert len(simulated(tmp_path)) == 4
    assert off(tmp_path, skirt) < EXACT
    assert abs(made.world_at(skirt, 4)[:, 0].mean() - 0.24) < 0.03


def test_an_instance_with_modifiers_is_the_body(tmp_path: Path) -> None:
    made.fresh(last=3)
    vertices, faces = made.tube(10, 5, 0.15, 0.0, 1.0, caps=True)
    trunk = made.add("Trunk", vertices, faces)
    trunk.modifiers.new("Smooth", "SUBSURF").levels = 1
    group = bpy.data.collections.new("Group")
    group.objects.link(trunk)
    bpy.context.scene.collection.objects.unlink(trunk)
    empty = bpy.data.objects.new("Instance", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", group
    empty.location = (0.5, 0.0, 0.0)
    bpy.context.scene.collection.objects.link(empty)
    skirt = made.skirt()
    skirt.location.x = 0.5
    bpy.context.view_layer.update()
    made.wear(empty, skirt)
    done = bake()
    assert not done.error, done.error
    captured = np.load(folder(tmp_path) / "capture" / "body.npz")["verts"]
    assert captured.shape[1] > 2 * len(vertices)
    assert captured[0, :, 0].mean() == pytest.approx(0.5, abs=1e-3)
    assert off(tmp_path, skirt) < EXACT


def test_far_from_the_origin(tmp_path: Path) -> None:
    made.fresh(last=3)
    body, rig = made.character()
    skirt = made.skirt()
    rig.animation_data_clear()
    for one in (rig, body, skirt):
        one.location.x = 400.0
    body.parent = None
    made.wear(body, skirt)
    done = bake()
    assert not done.error, done.error
    assert made.world_at(skirt, 3)[:, 0].mean() == pytest.approx(400.0, abs=0.01)


def test_two_garments_of_several_fabrics_with_loose_and_doubled_vertices(tmp_path: Path) -> None:
    made.fresh(last=4)
    body, _ = made.character()
    inner, outer = made.skirt(name="Slip", radius=0.165), made.skirt(name="Über Rock", radius=0.18)
    for name in ("upper", "lower", "of no face"):
        outer.data.materials.append(bpy.data.materials.new(name))
    for polygon in outer.data.polygons:
        polygon.material_index = int(polygon.center.z < 0.5)
    settings = made.wear(body, inner, outer)
    settings.garments[0].fabric = "silk_crepe"
    settings.garments[1].by_slot = True
    settings.garments[1].slots[1].fabric = "denim"
    inner.data.vertices.add(1)  # loose
    inner.data.update()
    done = bake()
    assert not done.error, done.error
    count = 32 * 9
    expected = simulated(tmp_path)
    assert expected.shape[1] == 2 * count
    for garment, start in ((inner, 0), (outer, count)):
        there = np.array([made.world_at(garment, 1 + k)[:count] for k in range(4)])
        assert np.abs(there - expected[:, start : start + count]).max() < EXACT
    command = (folder(tmp_path) / "run" / "config.yaml").read_text()
    assert "ber_rock__1_denim: denim" in command
    assert "silk_crepe" in command or "slip" in command


def test_shape_keys_give_the_same_positions_and_a_second_bake_replaces_them(tmp_path: Path) -> None:
    made.fresh(last=4)
    body, rig = made.character()
    skirt = made.skirt()
    skirt.modifiers.new("Armature", "ARMATURE").object = rig
    settings = made.wear(body, skirt)
    settings.result = "KEYS"
    for _ in range(2):
        done = bake()
        assert not done.error, done.error
        assert len(skirt.data.shape_keys.key_blocks) == 1 + 4
        assert off(tmp_path, skirt) < EXACT
    settings.result = "CACHE"
    assert not bake().error
    assert len(skirt.data.shape_keys.key_blocks) == 1
    assert skirt.modifiers["Armature"].show_viewport
    assert off(tmp_path, skirt) < EXACT


def test_wind_gravity_and_pins_reach_hood(tmp_path: Path) -> None:
    scene = made.fresh(last=3)
    body, _ = made.character()
    skirt = made.skirt()
    made.wear(body, skirt)
    scene.gravity = (0.0, 0.0, -1.62)
    wind = bpy.data.objects.new("Wind", None)
    scene.collection.objects.link(wind)
    bpy.context.view_layer.objects.active = wind
    with bpy.context.temp_override(object=wind, active_object=wind):
        bpy.ops.object.forcefield_toggle()
    wind.field.type, wind.field.strength = "WIND", 3.0
    wind.rotation_euler = (0.0, np.pi / 2, 0.0)
    bpy.context.view_layer.update()
    assert not bake().error
    config = (folder(tmp_path) / "run" / "config.yaml").read_text()
    assert "gravity: 1.62" in config
    assert [float(row.strip("- ")) for row in config.split("wind:\n")[1].splitlines()[:3]] == pytest.approx([3, 0, 0], abs=1e-5)
    pins = json.loads((folder(tmp_path) / "pins.json").read_text())
    assert pins == [{"vertices": [*range(8 * 32, 9 * 32)], "follows": "skin"}]


def test_pins_follow_a_group_of_the_body_and_weights_are_springs(tmp_path: Path) -> None:
    made.fresh(last=3)
    body, _ = made.character(swing=0.0)
    skirt = made.skirt()
    made.turned(skirt)
    waist = skirt.vertex_groups["waist"]
    waist.add([8 * 32, 8 * 32 + 1], 0.25, "REPLACE")
    settings = made.wear(body, skirt)
    settings.garments[0].follows = "chest"
    done = bake()
    assert not done.error, done.error
    (row,) = json.loads((folder(tmp_path) / "pins.json").read_text())
    assert row["weights"] == [0.25, 0.25] + [1.0] * 30
    assert set(row["follows"]) == {vertex.index for vertex in body.data.vertices if vertex.co.z > 0.5}
    assert off(tmp_path, skirt) < EXACT
    moved = simulated(tmp_path)[2, 8 * 32 + 2 :, :2].mean(axis=0) - simulated(tmp_path)[0, 8 * 32 + 2 :, :2].mean(axis=0)
    assert moved == pytest.approx([0.02, 0.01], abs=2e-3)


def test_from_a_fresh_scene_to_a_baked_shirt_with_three_operators() -> None:
    made.fresh(last=3)
    body, _ = made.character()
    shirt = made.skirt(name="Shirt", low=0.5, high=0.95)
    bpy.context.view_layer.objects.active = body
    assert bpy.ops.hood.body_set() == {"FINISHED"}
    for one in bpy.context.selected_objects:
        one.select_set(False)
    shirt.select_set(True)
    assert bpy.ops.hood.garment_add() == {"FINISHED"}
    bpy.context.scene.hood.garments[0].pins = "waist"
    assert bpy.ops.hood.bake(wait=True) == {"FINISHED"}
    assert np.abs(made.world_at(shirt, 3) - made.world_at(shirt, 1)).max() > 1e-3
