"""The course of a bake: cancel, resume, what is used again, undo, and errors that name object, index and fix."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import bpy
import characters as made
import numpy as np
import pytest
from case_results import bake, folder
from conftest import PREFERENCES
from hood_blender import bake as baking
from hood_blender import job, point_cache

#: All but the last tests need a hood that starts at once; what hood itself makes of a bake is in case_results.
quickly = pytest.mark.usefixtures("quick")


def begin() -> Any:
    """Begin a bake that the test moves on."""
    assert bpy.ops.hood.bake() == {"FINISHED"}
    found = job.job_of(bpy.context.scene.name)
    assert found.running
    return found


def move_until(one: Any, reached: Any, seconds: float = 120.0) -> None:
    """Move a job on until ``reached()``."""
    until = time.monotonic() + seconds
    while not reached() and time.monotonic() < until:
        pause = one.move_on()
        assert pause is not None, (one.error, one.progress)
        time.sleep(pause)
    assert reached()


def test_registration_leaves_nothing_behind() -> None:
    import hood_blender

    made.fresh()
    assert "FABRICS" not in dir(bpy.types.Scene)
    hood_blender.unregister()
    assert not hasattr(bpy.types.Scene, "hood")
    assert not hasattr(bpy.types, "HOOD_PT_main")
    hood_blender.register()
    assert bpy.context.scene.hood.quality == "standard"


def test_the_list_keeps_the_order_from_the_body_outwards() -> None:
    made.fresh()
    body, _ = made.character()
    first, second = made.skirt(name="A"), made.skirt(name="B", radius=0.18)
    settings = made.wear(body, first, second)
    settings.active = 1
    assert bpy.ops.hood.garment_move(direction="UP") == {"FINISHED"}
    assert [row.object.name for row in settings.garments] == ["B", "A"]
    assert bpy.ops.hood.garment_move(direction="UP") == {"CANCELLED"}
    assert bpy.ops.hood.garment_remove() == {"FINISHED"}
    assert [row.object.name for row in settings.garments] == ["A"]


@quickly
def test_cancel_while_it_captures_and_the_frame_comes_back() -> None:
    scene = made.fresh(last=200)
    body, _ = made.character()
    made.wear(body, made.skirt())
    scene.frame_set(7)
    one = begin()
    move_until(one, lambda: one.progress.work == "Capturing" and one.progress.done > 3)
    assert bpy.ops.hood.cancel() == {"FINISHED"}
    assert not one.running
    assert one.cancelled
    assert scene.frame_current == 7
    assert bpy.ops.hood.cancel() == {"CANCELLED"}


@quickly
def test_cancel_while_it_simulates_and_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made.fresh(last=40)
    body, _ = made.character()
    skirt = made.skirt()
    made.wear(body, skirt)
    monkeypatch.setenv("QUICK_SECONDS", "0.05")
    one = begin()
    move_until(one, lambda: one.progress.work == "Simulating" and one.progress.done > 4)
    assert skirt.modifiers["hood"].type == "MESH_CACHE"  # frames are shown while it runs
    assert one.progress.total == 40
    assert bpy.ops.hood.bake() == {"CANCELLED"}
    assert bpy.ops.hood.cancel() == {"FINISHED"}
    assert one.running  # until hood has ended; nothing waits for it
    one.wait()
    assert one.cancelled
    assert not one.error
    there = point_cache.read_header(folder(tmp_path) / "skirt.pc2").samples
    assert 4 < there < 40
    captured = (folder(tmp_path) / "capture" / "body.npz").stat().st_mtime_ns
    monkeypatch.setenv("QUICK_SECONDS", "0")
    done = bake()
    assert not done.error, done.error
    assert (folder(tmp_path) / "capture" / "body.npz").stat().st_mtime_ns == captured
    assert f"begins with frame {there}" in (folder(tmp_path) / "log.txt").read_text()
    assert point_cache.read_header(folder(tmp_path) / "skirt.pc2").samples == 40
    assert followed(body, skirt) < 1e-5


def followed(body: Any, garment: Any) -> float:
    """How far [m] the garment is from where the stand-in puts it: with the mean of the body."""
    scene = bpy.context.scene
    start, last = (made.world_at(garment, frame) for frame in (scene.frame_start, scene.frame_end))
    went = [made.world_at(body, frame).mean(axis=0) for frame in (scene.frame_start, scene.frame_end)]
    return float(np.abs(last - start - (went[1] - went[0])).max())


@quickly
def test_another_fabric_keeps_the_capture_and_another_motion_does_not(tmp_path: Path) -> None:
    made.fresh(last=3)
    body, rig = made.character()
    settings = made.wear(body, made.skirt())
    assert not bake().error
    archive = folder(tmp_path) / "capture" / "body.npz"
    captured = archive.stat().st_mtime_ns
    settings.garments[0].fabric = "denim"
    done = bake()
    assert archive.stat().st_mtime_ns == captured
    assert any("capture is used again" in note for note in done.progress.notes)
    assert not done.error
    chest = rig.pose.bones["chest"]
    chest.rotation_euler = (0.05, 0.0, 0.0)
    chest.keyframe_insert("rotation_euler", frame=2)
    assert not bake().error
    assert archive.stat().st_mtime_ns > captured


@quickly
def test_renaming_while_it_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = made.fresh(last=3)
    body, _ = made.character()
    skirt = made.skirt()
    made.wear(body, skirt)
    monkeypatch.setenv("QUICK_SECONDS", "0.3")
    one = begin()
    move_until(one, lambda: one.progress.runs)
    skirt.name = "Renamed"
    one.wait()
    assert not one.error, one.error
    assert scene.objects["Renamed"].modifiers["hood"].type == "MESH_CACHE"
    assert followed(body, scene.objects["Renamed"]) < 1e-5


@quickly
def test_a_garment_that_is_deleted_while_it_runs_is_one_message(monkeypatch: pytest.MonkeyPatch) -> None:
    made.fresh(last=3)
    body, _ = made.character()
    skirt = made.skirt()
    made.wear(body, skirt)
    monkeypatch.setenv("QUICK_SECONDS", "0.3")
    one = begin()
    move_until(one, lambda: one.progress.runs)
    bpy.data.objects.remove(skirt)
    one.wait()
    assert one.error.startswith("Skirt: is not there any more")


@quickly
def test_a_killed_process_is_said_and_the_next_bake_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made.fresh(last=4)
    body, _ = made.character()
    skirt = made.skirt()
    made.wear(body, skirt)
    begun: list[Any] = []
    real = baking.process.Process

    def started(*words: Any) -> Any:
        begun.append(real(*words))
        return begun[-1]

    monkeypatch.setattr(baking.process, "Process", started)
    monkeypatch.setenv("QUICK_SECONDS", "0.5")
    one = begin()
    move_until(one, lambda: one.progress.runs)
    os.kill(begun[-1]._process.pid, signal.SIGKILL)
    one.wait()
    assert "was ended by signal 9" in one.error
    monkeypatch.setenv("QUICK_SECONDS", "0")
    assert not bake().error
    assert followed(body, skirt) < 1e-5


@quickly
def test_an_estimate_says_seconds_and_changes_no_garment(tmp_path: Path) -> None:
    scene = made.fresh(last=50)
    body, _ = made.character()
    skirt = made.skirt()
    settings = made.wear(body, skirt)
    assert bpy.ops.hood.estimate(wait=True) == {"FINISHED"}
    assert settings.seconds_per_frame > 0
    assert not skirt.modifiers
    assert not folder(tmp_path).exists()
    assert scene.frame_current == 1


def refused(settings: Any = None) -> str:
    """The message of a bake that is refused."""
    one = bake()
    assert one.error
    assert one.progress.faults[0].text
    return str(one.error)


@quickly
def test_what_is_missing_is_said_before_anything_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = made.fresh(last=3)
    body, _ = made.character()
    skirt = made.skirt()
    settings = scene.hood
    assert "no garment is in the list" in refused()
    settings.garments.add().object = skirt
    assert "no body is chosen" in refused()
    settings.body = body
    scene.frame_end = 1
    assert "the range from frame 1 to 1 is empty" in refused()
    scene.frame_end = 3
    settings.garments[0].pins = "belt"
    assert "Skirt: has no vertex group 'belt' (it has waist)" in refused()
    settings.garments[0].pins = "waist"
    settings.garments[0].follows = "tail"
    assert "Body: has no vertex group 'tail' (it has hips, chest)" in refused()
    settings.garments[0].follows = ""
    settings.garments.add().object = skirt
    assert "Skirt: is in the list twice" in refused()
    settings.garments.remove(1)
    skirt.modifiers.new("Half", "MIRROR")
    assert "Skirt: modifier Half (Mirror) makes a part of the garment; apply it" in refused()
    skirt.modifiers.clear()
    scene.gravity = (1.0, 0.0, -9.81)
    assert "gravity is (1, 0, -9.81)" in refused()
    scene.gravity = (0.0, 0.0, -9.81)
    monkeypatch.setitem(PREFERENCES, "program", "/nowhere/hood")
    assert "/nowhere/hood: no such program" in refused()
    monkeypatch.setitem(PREFERENCES, "program", "/bin/echo")
    assert "/bin/echo: is no hood (" in refused()
    old = tmp_path / "old"
    old.write_text("#!/bin/sh\necho 'hood 0.0.9 (hood-cloth)'\n")
    old.chmod(0o755)
    monkeypatch.setitem(PREFERENCES, "program", str(old))
    assert "is hood 0.0.9, the add-on needs 0.1.0 or newer" in refused()
    monkeypatch.setitem(PREFERENCES, "program", "")
    monkeypatch.setenv("PATH", str(tmp_path / "empty"))
    assert "hood is not installed; press Install hood" in refused()
    assert not skirt.modifiers


@quickly
def test_meshes_that_cannot_be_simulated_are_named_and_can_be_selected() -> None:
    made.fresh(last=3)
    body, _ = made.character()
    skirt = made.skirt()
    made.wear(body, skirt)
    mesh = skirt.data
    tip = len(mesh.vertices)
    mesh.vertices.add(1)
    mesh.vertices[tip].co = (0.3, 0.0, 0.5)
    corners, start = len(mesh.loops), len(mesh.polygons)
    mesh.loops.add(3)
    mesh.polygons.add(1)
    mesh.polygons[start].loop_start = corners
    for place, vertex in enumerate((33, 34, tip)):
        mesh.loops[corners + place].vertex_index = vertex
    mesh.update(calc_edges=True)
    assert "the edge between vertices 33 and 34 has 3 faces" in refused()
    assert bpy.ops.hood.fault_select(index=0) == {"FINISHED"}
    assert bpy.context.mode == "EDIT_MESH"
    assert "is in edit mode" in refused()
    bpy.ops.object.mode_set(mode="OBJECT")
    assert [vertex.index for vertex in mesh.vertices if vertex.select] == [33, 34]


@quickly
def test_a_body_that_changes_its_mesh_or_is_hidden_is_said() -> None:
    made.fresh(last=3)
    body, _ = made.character()
    made.wear(body, made.skirt())
    build = body.modifiers.new("Grow", "BUILD")
    build.frame_start, build.frame_duration = 0, 10
    assert "a body keeps its mesh: switch off the modifier that changes it (Armature, Grow)" in refused()
    body.modifiers.remove(build)
    body.hide_viewport = True
    assert "body Body has no faces, or is hidden" in refused()


def test_an_error_of_hood_comes_into_the_list_and_earlier_frames_stay(tmp_path: Path) -> None:
    made.fresh(last=3)
    body, _ = made.character()
    skirt = made.skirt()
    settings = made.wear(body, skirt)
    assert not bake().error
    settings.more = "no_such_key=1"
    assert "no_such_key" in refused()
    assert point_cache.read_header(folder(tmp_path) / "skirt.pc2").samples == 3
    settings.more = ""
    skirt.data.transform(np.diag([1, 1, 1, 1]))
    for vertex in skirt.data.vertices:
        vertex.co.x += 3.0
    message = refused()
    assert "skirt" in message
    assert "not worn" in message
    assert point_cache.read_header(folder(tmp_path) / "skirt.pc2").samples == 3


@quickly
def test_a_linked_garment_is_refused_and_an_override_is_baked(tmp_path: Path) -> None:
    made.fresh(last=3)
    made.skirt()
    library = tmp_path / "library.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(library))
    scene = made.fresh(last=3)
    body, _ = made.character()
    with bpy.data.libraries.load(str(library), link=True) as (there, here):
        here.objects = ["Skirt"]
    linked = here.objects[0]
    scene.collection.objects.link(linked)
    made.wear(body, linked)
    assert "Skirt: is linked from" in refused()
    override = linked.override_create(remap_local_usages=True)
    scene.hood.garments[0].object = override
    if scene.objects.get(override.name) is None:
        scene.collection.objects.link(override)
    done = bake()
    assert not done.error, done.error
    assert override.modifiers["hood"].type == "MESH_CACHE"


@quickly
def test_a_saved_file_keeps_a_relative_cache(tmp_path: Path) -> None:
    made.fresh(last=3)
    body, _ = made.character()
    skirt = made.skirt()
    made.wear(body, skirt)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    done = bake()
    assert not done.error, done.error
    assert skirt.modifiers["hood"].filepath.startswith("//hood_cache")
    before = made.world_at(skirt, 3)
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))
    assert np.array_equal(made.world_at(bpy.data.objects["Skirt"], 3), before)
    assert [row.object.name for row in bpy.context.scene.hood.garments] == ["Skirt"]


class Layout:
    """Stands for a layout of the interface: everything that is drawn has to be there."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def prop(self, data: Any, name: str, **words: Any) -> None:
        assert hasattr(data, name), name

    def prop_search(self, data: Any, name: str, where: Any, group: str) -> None:
        assert hasattr(data, name)
        assert hasattr(where, group)

    def operator(self, name: str, **words: Any) -> Any:
        room, _, own = name.partition(".")
        assert own in dir(getattr(bpy.ops, room)), name
        self.texts.append(words.get("text", ""))
        return type("Properties", (), {})()

    def template_list(self, kind: str, _: str, data: Any, name: str, active: Any, index: str, **words: Any) -> None:
        assert hasattr(data, name)
        assert hasattr(active, index)

    def label(self, text: str = "", **words: Any) -> None:
        self.texts.append(text)

    def progress(self, factor: float, text: str) -> None:
        assert 0.0 <= factor <= 1.0
        self.texts.append(text)

    def row(self, **words: Any) -> Layout:
        return self

    box = column = row


def drawn() -> str:
    """What the panel shows."""
    layout = Layout()
    bpy.types.HOOD_PT_main.draw(type("Panel", (), {"layout": layout})(), bpy.context)
    return "\n".join(layout.texts)


@quickly
def test_the_panel_shows_garments_progress_time_and_faults(monkeypatch: pytest.MonkeyPatch) -> None:
    made.fresh(last=30)
    assert "Frames 1 to 30" in drawn()
    body, _ = made.character()
    skirt = made.skirt()
    for name in ("a", "b"):
        skirt.data.materials.append(bpy.data.materials.new(name))
    settings = made.wear(body, skirt)
    settings.garments[0].by_slot = True
    assert len(settings.garments[0].slots) == 2
    reasons = [{"kind": "strain", "sentence": "skirt: torn at vertex 3"}]
    monkeypatch.setenv("QUICK_FAULTS", json.dumps(reasons))
    monkeypatch.setenv("QUICK_SECONDS", "0.05")
    one = begin()
    move_until(one, lambda: one.progress.work == "Simulating")
    assert "Simulating: " in drawn()
    assert " of 30" in drawn()
    one.wait()
    shown = drawn()
    assert "Frames 1 to 30: 0.1 s each, about 3 s" in shown
    assert "skirt: torn at vertex 3" in shown
    assert "Select 1 vertices" in shown
    assert "5% larger" in shown


@quickly
def test_undo_between_two_bakes_leaves_one_modifier() -> None:
    made.fresh(last=3)
    body, _ = made.character()
    skirt = made.skirt()
    made.wear(body, skirt)
    bpy.ops.ed.undo_push(message="before")
    assert not bake().error
    bpy.ops.ed.undo_push(message="baked")
    bpy.ops.ed.undo()
    assert not bake().error
    assert [modifier.name for modifier in bpy.data.objects["Skirt"].modifiers] == ["hood"]


@quickly
def test_faults_name_polygons_of_blender_and_select_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two garments; triangles 2 and 3 of hood's outer one are Blender's second quad."""
    scene = made.fresh(last=4)
    body, _ = made.character()
    inner, outer = made.skirt(name="Slip", radius=0.165), made.skirt(name="Coat", radius=0.18)
    made.wear(body, inner, outer)
    count = 2 * 32 * 8
    reasons = [
        {"kind": "garments_through_each_other", "sentence": "cloth crosses", "frame": 2, "triangles": [count + 2, count + 3]},
        {"kind": "strain", "sentence": "coat: torn at 2 vertices", "vertices": [0, 1]},
    ]
    monkeypatch.setenv("QUICK_FAULTS", json.dumps(reasons))
    done = bake()
    assert not done.error
    assert done.progress.work == "Finished, with faults"
    assert bpy.ops.hood.fault_select(index=0) == {"FINISHED"}
    assert scene.frame_current == 3
    bpy.ops.object.mode_set(mode="OBJECT")
    assert bpy.context.view_layer.objects.active == outer
    assert [polygon.index for polygon in outer.data.polygons if polygon.select] == [1]
    assert bpy.ops.hood.fault_select(index=1) == {"FINISHED"}
    bpy.ops.object.mode_set(mode="OBJECT")
    assert [vertex.index for vertex in outer.data.vertices if vertex.select] == [0, 1]
    assert bpy.ops.hood.fault_repair(index=0) == {"FINISHED"}
    assert bpy.ops.hood.fault_repair(index=1) == {"FINISHED"}
    assert scene.hood.more == "settle=3 size=1.05"
    assert bpy.ops.hood.fault_repair(index=7) == {"CANCELLED"}


def test_an_installation_runs_its_commands_and_says_what_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from hood_blender import operators

    monkeypatch.setattr(operators, "own_hood", lambda: tmp_path / "own" / "venv")
    monkeypatch.setitem(PREFERENCES, "program", "")
    with pytest.raises(RuntimeError, match="no source is named"):
        bpy.ops.hood.install(wait=True)
    package = tmp_path / "broken"
    package.mkdir()
    (package / "pyproject.toml").write_text("[build-system]\nrequires = []\nbuild-backend = 'none'\nbackend-path = ['.']\n")
    monkeypatch.setitem(PREFERENCES, "source", str(package))
    with pytest.raises(RuntimeError, match=r"the installation failed: .*install\.txt"):
        bpy.ops.hood.install(wait=True)
    assert (tmp_path / "own" / "venv" / "pyvenv.cfg").is_file()


def test_blender_installs_the_zip_and_switches_it_on(tmp_path: Path) -> None:
    import make_zip

    made_zip = make_zip.make_zip(tmp_path / "hood_blender.zip")
    lines = [
        "import bpy",
        "bpy.ops.preferences.addon_enable(module='bl_pkg')",
        f"bpy.ops.extensions.package_install_files(filepath={str(made_zip)!r}, repo='user_default', enable_on_install=True)",
        "(name,) = [one for one in bpy.context.preferences.addons.keys() if 'hood' in one]",
        "bpy.context.preferences.addons[name].preferences.program = 'named'",
        "assert bpy.context.scene.hood.quality == 'standard'",
        "assert bpy.ops.hood.body_set.poll()",
        "bpy.ops.preferences.addon_disable(module=name)",
        "assert not hasattr(bpy.types.Scene, 'hood')",
        "print('it works')",
    ]
    environment = os.environ | {"BLENDER_USER_RESOURCES": str(tmp_path / "resources")}
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)], env=environment, capture_output=True, text=True, check=False
    )
    assert "it works" in done.stdout, done.stdout + done.stderr
