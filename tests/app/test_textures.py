"""``texture=``: readers that are not ours get image and coordinates back, and what cannot be is one sentence."""

from __future__ import annotations

import base64
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from test_export import DT, FACES, FRAMES, UV, UV_FACES, _glb, _rollout
from test_view import content

from hood.assets.formats import raw_mesh as texture_module
from hood.cli.main import main
from hood.media.viewer.page import unpack_integers
from hood.rollouts.file.reader import read_rollout
from hood.rollouts.file.recorder import RolloutWriter

CHECKS = np.indices((16, 16)).sum(axis=0)[..., None] // 4 % 2 * np.array([200, 100, 50], np.uint8)


@pytest.fixture
def png(tmp_path: Path) -> Path:
    return _image(tmp_path / "checks.png", "PNG")


def _image(path: Path, form: str, pixels: np.ndarray = CHECKS) -> Path:
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(pixels.astype(np.uint8)).save(path, form)
    return path


def _pixels(image: Image.Image) -> np.ndarray:
    return np.asarray(image.convert("RGB"))


def _without_uv(folder: Path) -> Path:
    """The rollout of one garment whose file had no texture coordinates."""
    pos, path = read_rollout(_rollout(folder)).cloth_pos, folder / "bare.h5"
    names = ("rg",)
    with RolloutWriter(path, FRAMES, pos[0], FACES, np.zeros((0, 3)), 0, names, DT, {"garment": "cape"}) as out:
        for frame in pos:
            out.append(frame, np.zeros((0, 3)), {"rg": 0.0})
    return path


def test_glb_holds_the_image_and_repeats_it(tmp_path: Path, png: Path) -> None:
    assert main(["export", str(_rollout(tmp_path)), f"texture={{top:{png}}}"]) == 0
    document, _ = _glb(tmp_path / "rollout.glb")
    assert document["samplers"] == [{"wrapS": 10497, "wrapT": 10497, "magFilter": 9729, "minFilter": 9987}]
    assert ["baseColorTexture" in one["pbrMetallicRoughness"] for one in document["materials"]] == [True, False, False]
    top = trimesh.load(tmp_path / "rollout.glb").geometry["top"]
    assert np.array_equal(_pixels(top.visual.material.baseColorTexture), CHECKS)
    assert np.allclose(top.visual.uv[top.faces], UV[UV_FACES[:2]], atol=1e-6)
    pos = read_rollout(tmp_path / "rollout.h5").cloth_pos[0]
    assert np.allclose(top.vertices[top.faces], pos[FACES[:2]], atol=1e-6)


def test_one_image_on_two_garments_is_stored_once(tmp_path: Path, png: Path) -> None:
    assert main(["export", str(_rollout(tmp_path)), f"texture={png}"]) == 0
    document, _ = _glb(tmp_path / "rollout.glb")
    assert len(document["images"]) == 1
    textures = [one["pbrMetallicRoughness"].get("baseColorTexture") for one in document["materials"]]
    assert textures == [{"index": 0}, {"index": 0}, None]


def test_usd_has_a_material_with_the_image_beside_it(tmp_path: Path, png: Path) -> None:
    pytest.importorskip("pxr", reason="usd-core has no wheel for this machine")
    from pxr import Usd, UsdGeom, UsdShade

    jpg = _image(tmp_path / "b" / "checks.jpg", "JPEG")
    source = _rollout(tmp_path)
    assert (
        main(["export", str(source), "format=usd", f"texture={{top:{png},skirt:{jpg}}}", f"output={tmp_path / 'made.usda'}"])
        == 0
    )
    stage = Usd.Stage.Open(str(tmp_path / "made.usda"))
    for name, image, faces in (("top", png, UV_FACES[:2]), ("skirt", jpg, UV_FACES[2:])):
        prim = stage.GetPrimAtPath(f"/rollout/{name}")
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        surface, _, _ = material.ComputeSurfaceSource()
        assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
        texture = UsdShade.Shader(surface.GetInput("diffuseColor").GetConnectedSources()[0][0].source)
        assert texture.GetIdAttr().Get() == "UsdUVTexture"
        assert Path(texture.GetInput("file").Get().resolvedPath).read_bytes() == image.read_bytes()
        assert [texture.GetInput(axis).Get() for axis in ("wrapS", "wrapT")] == ["repeat", "repeat"]
        reader = UsdShade.Shader(texture.GetInput("st").GetConnectedSources()[0][0].source)
        primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(reader.GetInput("varname").Get())
        assert np.allclose(primvar.ComputeFlattened(), UV[faces.reshape(-1)])
    assert UsdShade.MaterialBindingAPI(stage.GetPrimAtPath("/rollout/body")).ComputeBoundMaterial()[0].GetPath().isEmpty
    assert {file.name for file in tmp_path.iterdir() if file.is_file()} == {
        "checks.png", "rollout.h5", "made.usda", "made_top_texture.png", "made_skirt_texture.jpg",
    }  # fmt: skip


@pytest.mark.parametrize("form", ["obj", "pc2"])
def test_obj_files_name_the_image(tmp_path: Path, png: Path, form: str) -> None:
    assert main(["export", str(_rollout(tmp_path)), f"format={form}", f"texture={{top:{png}}}"]) == 0
    folder = tmp_path / f"rollout_{form}"
    top = trimesh.load(folder / ("top_0001.obj" if form == "obj" else "top.obj"), process=False)
    assert np.array_equal(_pixels(top.visual.material.image), CHECKS)
    assert np.allclose(top.visual.uv[top.faces], UV[UV_FACES[:2]], atol=1e-6)
    assert not (folder / "skirt.mtl").exists()


def test_the_page_holds_image_and_seams(tmp_path: Path, png: Path) -> None:
    page = tmp_path / "page.html"
    assert main(["view", str(_rollout(tmp_path)), f"texture={{top:{png}}}", f"output={page}"]) == 0
    held = content(page.read_text())
    kind, data = held["images"][0].split(",")
    assert kind == "data:image/png;base64"
    assert base64.b64decode(data) == png.read_bytes()
    mapped = held["rollouts"][0]["mapped"]
    assert mapped["groups"] == [[2, 0], [2, None]]
    points, faces = unpack_integers(mapped["points"]), unpack_integers(mapped["faces"]).reshape(-1, 3)
    uv = mapped["step"] * unpack_integers(mapped["uv"]).reshape(-1, 2)
    assert np.array_equal(points[faces], FACES)
    assert np.allclose(uv[faces[:2]], UV[UV_FACES[:2]], atol=mapped["step"])
    assert len(points) == 6 + 4  # the top is torn along its diagonal, the skirt has no image
    assert main(["view", str(tmp_path / "rollout.h5"), f"output={page}"]) == 0
    bare = content(page.read_text())
    assert (bare["images"], bare["rollouts"][0]["mapped"]) == ([], None)


def test_pictures_and_formats_of_a_rollout_show_it(tmp_path: Path) -> None:
    red = _image(tmp_path / "red.png", "PNG", np.full((4, 4, 3), (255, 0, 0)))
    words = ("garment=skirt", "sequence=plie", "num_frames=1", "stepper=refine", "refine=1", "metrics=none", "video=none")
    assert main(["rollout", *words, f"texture={red}", "formats=[glb]", f"output={tmp_path / 'run'}"]) == 0
    sheet = np.asarray(Image.open(tmp_path / "run" / "contact_sheet.png")).astype(int)
    assert ((sheet[..., 0] > 100) & (sheet[..., 1:].max(axis=2) < 0.5 * sheet[..., 0])).mean() > 0.02
    image = trimesh.load(tmp_path / "run" / "rollout.glb").geometry["skirt"].visual.material.baseColorTexture
    assert _pixels(image).tolist() == [[[255, 0, 0]] * 4] * 4


@pytest.mark.parametrize(
    "words, said",
    [
        (["texture=gone.png"], "gone.png: no such file"),
        (["texture={tops:PNG}"], "did you mean 'top'?"),
        (["texture={top:3}"], "give an image, texture=plaid.png"),
        (["texture=[PNG]"], "give an image, texture=plaid.png"),
        (["texture=PNG", "format=ply"], "format=ply shows no images; take format=usd or glb"),
        (["texture=PNG", "parts=[body]"], "leaves the garments out"),
        (["texture=BARE"], "neither PNG nor JPEG"),
    ],
)
def test_refusals(tmp_path: Path, png: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str) -> None:
    source, before = _rollout(tmp_path), None
    words = [word.replace("PNG", str(png)).replace("BARE", str(source)) for word in words]
    before = sorted(tmp_path.iterdir())
    assert main(["export", str(source), *words]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


def test_a_garment_without_coordinates_is_named(tmp_path: Path, png: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = _without_uv(tmp_path)
    for words in (["export", str(path)], ["view", str(path), f"output={tmp_path / 'page.html'}"]):
        assert main([*words, f"texture={png}"]) == 2
        assert "garment 'cape' has no texture coordinates" in capsys.readouterr().err
    mesh = tmp_path / "cape.obj"
    sheet = trimesh.creation.box((0.5, 0.01, 0.5)).subdivide().subdivide()
    mesh.write_text(trimesh.exchange.obj.export_obj(sheet, include_normals=False))
    rollout = ["rollout", f"garment={mesh}", "body=none", "sequence=plie", "stepper=newton", f"output={tmp_path / 'run'}"]
    assert main([*rollout, f"texture={png}", "num_frames=1"]) == 2
    assert "garment 'cape' has no texture coordinates" in capsys.readouterr().err
    assert not (tmp_path / "run" / "rollout.h5").exists()


def test_images_that_nothing_would_show_are_refused(tmp_path: Path, png: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["video=none", "sheet=false"], ["colour=strain", "formats=[ply]"]):
        assert main(["rollout", f"texture={png}", *words, f"output={tmp_path / 'run'}"]) == 2
        assert "shows no images" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_large_image_is_refused(
    tmp_path: Path, png: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(texture_module, "_LARGEST", 100)
    assert main(["view", str(_rollout(tmp_path)), f"texture={png}", f"output={tmp_path / 'page.html'}"]) == 2
    assert "save it smaller" in capsys.readouterr().err
    assert not (tmp_path / "page.html").exists()
