"""The files that readers bring to the command lines of the pages, small, made when a command first names them."""

from __future__ import annotations

import pickle
import re
import runpy
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pages import ROOT, blocks
from PIL import Image
from reference_oracle import make_state
from sewing_patterns import skirt, write
from workshop import Workshop, write_obj

from hood.assets.garment.garment import Garment, load_garment, save_garment
from hood.cli.main import main
from hood.rollouts.file.recorder import RolloutWriter
from hood.studies.envelope.page import BEGIN, END
from hood.testing import cylinder, sphere

#: What makes a training short; the model and its weights are as large as the line's.
BRIEF = (
    "trainer.iterations=1", "trainer.batch_size=1", "trainer.statistics_iterations=0", "trainer.horizon.start=1",
    "trainer.workers=0", "trainer.log_every=1",
)  # fmt: skip
#: Words that say what a network is.
_OF_A_MODEL = re.compile(r"(experiment|model[\w.]*)=")


class Desk:
    """Makes files once, each kind in a folder of its own, and lays copies of those that a command names where it runs."""

    def __init__(self, folder: Path, go: Callable[[Path], None]) -> None:
        self.folder = folder
        self.workshop = Workshop(folder / "workshop")
        self.workshop.folder.mkdir()
        self.go = go
        self.makers: list[tuple[str, Callable[[str, Sequence[str]], Path]]] = [
            (r"outputs/set", self.data_set),
            (r"outputs/sewn", self.sewn),
            (r"(outputs/(?!plan/|set$|sewn$|unseen$)\w+|(.*/)?rollout\.h5)", self.rollout),
            (r"walk\.pkl", self.published_rollout),
            (r"long\.h5", self.long_rollout),
            (r"outputs/plan/plan\.json", self.plan),
            (r"([\w/]+/)?\w+\.safetensors", self.model),
            (r"postcvpr\.pth", self.published),
            (r"specification\.json", self.sewing_pattern),
            (r"SMPL_NEUTRAL\.pkl", self.smpl),
            (r"garments_dict\.pkl", self.published_garments),
            (r"vto/\w+\.csv", self.split),
            (r"(my_)?shirt\.obj|cape \(1\)\.obj|Röckchen\.obj", self.shirt),
            (r"(my_)?shirt\.npz", self.bound_shirt),
            (r"coat\.(obj|ply)|left\.txt|right\.txt", self.coat),
            (r"(my_)?walk\.npz|my_amass_file\.npz|amass(/.*)?", self.recording),
            (r"(first|second)\.txt", self.list_of_motions),
            (r"rows\.csv", self.rows),
            (r"split\.json", self.split_of_motions),
            (r"hero\.glb", self.hero),
            (r"models/SMPLX_NEUTRAL\.npz", self.smplx),
            (r"pieces/.*\.npz", self.piece),
            (r"skirt\.obj|twirl\.npz|skirt_prepared\.npz", self.of_tutorial),
            (r"hood/studies/notes/stability\.md", self.page),
            (r"(outputs/patterns/)?(plaid|bands|map)\.(png|jpg)", self.picture),
        ]

    def lay(self, words: Sequence[str], where: Path) -> None:
        """Copies of the files that the words name, under those names, into the folder ``where``."""
        given = [word for word in words[1:] if not word.startswith("output=")]
        values = [word.partition("=")[2] for word in given]
        for name in dict.fromkeys([*re.findall(r"[\w.*/-]+", " ".join(given)), *values]):
            for pattern, make in self.makers:
                if re.fullmatch(pattern, name):
                    made, target = make(name, words), where / _without_stars(name)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    if (made / target.name).is_file():  # with what lies beside it
                        shutil.copytree(made, target.parent, dirs_exist_ok=True)
                        continue
                    (shutil.copytree if made.is_dir() else shutil.copy)(made, target)

    def _once(self, name: str, make: Callable[[Path], object]) -> Path:
        """The folder ``name`` with what ``make`` writes into it."""
        folder = self.folder / re.sub(r"[^\w.]+", "_", name)
        if not folder.exists():
            folder.mkdir()
            before = Path.cwd()
            self.go(folder)
            make(folder)
            self.go(before)
        return folder

    def rollout(self, name: str, words: Sequence[str]) -> Path:
        def make(folder: Path) -> None:
            drawn = ["num_frames=12", "video=none", "sheet=false", "metrics={fields:[rg]}"]
            assert main(["rollout", "garment=dress", "stepper=guess", *drawn, "fail_on=nothing", "output=made"]) == 0

        made = self._once("rollout", make) / "made"
        return made / "rollout.h5" if name.endswith(".h5") else made

    def sewing_pattern(self, name: str, words: Sequence[str]) -> Path:
        return self._once("sewing_pattern", lambda folder: write(folder / name, skirt())) / name

    def data_set(self, name: str, words: Sequence[str]) -> Path:
        """What ``hood dress`` leaves of one row."""

        def make(folder: Path) -> None:
            shutil.copytree(self.rollout("outputs/row", words), folder / "made" / "dress" / "plie")
            line = '{"row": "dress/plie", "verdict": "sound", "settings": {}}\n'
            (folder / "made" / "manifest.jsonl").write_text(line, encoding="utf-8")

        return self._once("data set", make) / "made"

    def published_rollout(self, name: str, words: Sequence[str]) -> Path:
        def make(folder: Path) -> None:
            assert main(["convert", f"rollout={self.rollout('outputs/row', words)}", "output=walk.pkl"]) == 0

        return self._once("published rollout", make) / "walk.pkl"

    def long_rollout(self, name: str, words: Sequence[str]) -> Path:
        """Ninety frames of a tube about a ball."""

        def make(folder: Path) -> None:
            (pos, faces), (ball, ball_faces) = cylinder(12, 3, 0.3, 0.5), sphere(1, 0.25)
            with RolloutWriter(
                folder / "long.h5", 92, pos, faces, ball_faces, len(ball), (), 1 / 30, {"garment": "tube"}
            ) as out:
                for _ in range(92):
                    out.append(pos, ball, {}, {})

        return self._once("long", make) / "long.h5"

    def plan(self, name: str, words: Sequence[str]) -> Path:
        def make(folder: Path) -> None:
            short = ["windows=1", "frames=1", "parts=[friction]", "num_frames=12", "output=made"]
            assert main(["plan", "garment=tank", "stepper=newton", *short]) == 0

        return self._once("plan", make) / "made" / "plan.json"

    def model(self, name: str, words: Sequence[str]) -> Path:
        """What a training of the words' model wrote after an update; that of another command is the smallest."""
        chosen = [word for word in words if words[0] == "train" and _OF_A_MODEL.match(word)]
        chosen = chosen or ["model=small", "model.latent_dim=8"]

        def make(folder: Path) -> None:
            assert main(["train", *chosen, *BRIEF, "data.garments=[tank]", "data.sequences=[plie]", "output=made"]) == 0

        return self._once("model " + " ".join(chosen), make) / "made" / "model.safetensors"

    def published(self, name: str, words: Sequence[str]) -> Path:
        def make(folder: Path) -> None:
            torch.save({"training_module": make_state("postcvpr", 4)}, folder / "postcvpr.pth")

        return self._once("published", make) / "postcvpr.pth"

    def shirt(self, name: str, words: Sequence[str]) -> Path:
        """Around the T-pose, in centimetres where the words say so; or as the glTF body wears it in its first frame."""
        if "hero.glb" in " ".join(words):
            return Path(self.workshop.garment("tshirt", "posed"))
        unit = 0.01 if "scale=0.01" in words else 1.0
        panels = ("sleeve_left", "collar") if "collar" in " ".join(words) else ()

        def make(folder: Path) -> None:
            shirt = load_garment("tshirt")
            write_obj(folder / "shirt.obj", shirt.worn_pos / unit, shirt.faces)
            if panels:
                head, *faces = (folder / "shirt.obj").read_text(encoding="utf-8").partition("\nf ")
                rows = "".join(faces).strip().splitlines()
                groups = [f"g {name}\n{row}" for name, row in zip(panels, rows, strict=False)]
                (folder / "shirt.obj").write_text("\n".join([head, *groups, "g body", *rows[len(groups) :]]), encoding="utf-8")

        return self._once(f"shirt {unit} {' '.join(panels)}", make) / "shirt.obj"

    def picture(self, name: str, words: Sequence[str]) -> Path:
        """Red on the left, blue on the right."""

        def make(folder: Path) -> None:
            colours = np.zeros((8, 8, 3), dtype=np.uint8)
            colours[:, :4, 0] = colours[:, 4:, 2] = 255
            Image.fromarray(colours).save(folder / Path(name).name)

        return self._once(f"picture {Path(name).name}", make) / Path(name).name

    def bound_shirt(self, name: str, words: Sequence[str]) -> Path:
        return self._once("bound", lambda folder: save_garment(folder / "shirt.npz", load_garment("tshirt"))) / "shirt.npz"

    def sewn(self, name: str, words: Sequence[str]) -> Path:
        return self._once("sewn", lambda folder: save_garment(folder / "tank.npz", load_garment("tank")))

    def coat(self, name: str, words: Sequence[str]) -> Path:
        return self._once("coat", _write_coat) / name

    def recording(self, name: str, words: Sequence[str]) -> Path:
        """The layout of AMASS; a folder of two where one is asked for."""
        file = Path(self.workshop.motion("amass_smplh"))
        if name.endswith(".npz"):
            return file

        def make(folder: Path) -> None:
            for subject in ("01", "02"):
                shutil.copy(file, folder / f"{subject}_poses.npz")

        return self._once("amass", make)

    def list_of_motions(self, name: str, words: Sequence[str]) -> Path:
        """One of the two recordings in the folder ``amass``."""
        entry = "amass/01_poses.npz" if name == "first.txt" else "amass/02_poses.npz"
        return self._once(name, lambda folder: (folder / name).write_text(entry, encoding="utf-8")) / name

    def split_of_motions(self, name: str, words: Sequence[str]) -> Path:
        """The split of the page about own files, with the folders that it names."""
        (text,) = [block.text for block in blocks(ROOT / "docs" / "own_data.md") if block.language == "json"]

        def make(folder: Path) -> None:
            for place in ("CMU", "ACCAD/01"):
                shutil.copytree(self.recording("amass", words), folder / "amass" / place)
            (folder / name).write_text(text, encoding="utf-8")

        return self._once("split", make)

    def rows(self, name: str, words: Sequence[str]) -> Path:
        text = "garment,sequence,size\ntank,plie,1.05\n"
        return self._once(name, lambda folder: (folder / name).write_text(text, encoding="utf-8")) / name

    def hero(self, name: str, words: Sequence[str]) -> Path:
        return Path(self.workshop.body("gltf_skin"))

    def smplx(self, name: str, words: Sequence[str]) -> Path:
        """A body model of this layout."""
        return Path(self.workshop.body("smplx_npz"))

    def smpl(self, name: str, words: Sequence[str]) -> Path:
        """A body model as its authors give it."""
        return Path(self.workshop.body("smpl_pickle"))

    def published_garments(self, name: str, words: Sequence[str]) -> Path:
        """Two garments in the layout of the published ones."""

        def make(folder: Path) -> None:
            garments = {garment: published_entry(load_garment(garment)) for garment in ("dress", "tshirt")}
            (folder / name).write_bytes(pickle.dumps(garments, 2))

        return self._once("published_garments", make) / name

    def split(self, name: str, words: Sequence[str]) -> Path:
        """A table of motions as the published one; the motion is laid beside it."""
        file = Path(self.workshop.motion("amass_smplh"))

        def make(folder: Path) -> None:
            shutil.copy(file, folder / "01_01_poses.npz")
            for part in ("train", "validation"):
                (folder / f"{part}.csv").write_text("id,length,garment\n01_01_poses,30,dress\n", encoding="utf-8")

        return self._once("vto", make)

    def piece(self, name: str, words: Sequence[str]) -> Path:
        def make(folder: Path) -> None:
            script = runpy.run_path(str(ROOT / "scripts" / "cut_pieces.py"))
            for piece in [*script["pieces"](), *script["fine_pieces"]()]:
                save_garment(folder / f"{piece.name}.npz", piece)

        return self._once("pieces", make) / Path(name).name

    def of_tutorial(self, name: str, words: Sequence[str]) -> Path:
        """The two files that the tutorial's Python writes, half as fine, and what its third command makes of the skirt."""

        def make(folder: Path) -> None:
            python = next(block.text for block in blocks(ROOT / "docs" / "tutorial.md") if block.language == "python")
            coarse = python.replace("around, down = 80, 52", "around, down = 56, 36")
            assert coarse != python
            exec(compile(coarse, "own_files.py", "exec"), {})
            assert main(["prepare", "garment=skirt.obj", "scale=0.01", "pins=waistband"]) == 0

        return self._once("tutorial", make) / name

    def page(self, name: str, words: Sequence[str]) -> Path:
        return self._once("page", lambda folder: _write_page(folder / "stability.md")) / "stability.md"


def published_entry(garment: Garment) -> dict[str, Any]:
    """A garment of ours as an entry of ``garments_dict.pkl``."""
    count = len(garment.rest_pos)
    return {
        "rest_pos": garment.rest_pos.astype(np.float32),
        "faces": garment.faces.astype(np.int32),
        "node_type": np.where(garment.pinned, 3, 0)[:, None],
        "lbs": {
            "v": garment.tpose(np.zeros(10)).astype(np.float32),
            "f": garment.faces,
            "shapedirs": np.zeros((count, 3, 10)),
            "posedirs": np.zeros((207, 3 * count)),
            "lbs_weights": garment.lbs_weights,
        },
        "center": [0],
        "coarse_edges": {},
    }


def _without_stars(name: str) -> str:
    return name.replace("**/*", "01/01")


def _write_page(path: Path) -> None:
    path.write_text(f"before\n\n{BEGIN}\n{END}\n\nafter\n", encoding="utf-8")


def _write_coat(folder: Path) -> None:
    """A jacket as a reader has it: without fasteners, its edges painted in the PLY and listed in two texts."""
    jacket = load_garment("jacket")
    assert jacket.fasteners is not None
    pairs = jacket.fasteners["front_zip"]
    write_obj(folder / "coat.obj", jacket.worn_pos, jacket.faces)
    for side, name in enumerate(("left", "right")):
        (folder / f"{name}.txt").write_text(" ".join(map(str, pairs[:, side])), encoding="utf-8")
    colours = np.full((len(jacket.rest_pos), 3), 200)
    colours[pairs[:, 0]], colours[pairs[:, 1]] = (255, 0, 0), (0, 255, 0)
    _write_ply(folder / "coat.ply", jacket, colours)


def _write_ply(path: Path, garment: Garment, colours: np.ndarray) -> None:
    fields = [*(f"property float {axis}" for axis in "xyz"), *(f"property uchar {name}" for name in ("red", "green", "blue"))]
    head = ["ply", "format ascii 1.0", f"element vertex {len(colours)}", *fields]
    head += [f"element face {len(garment.faces)}", "property list uchar int vertex_indices", "end_header"]
    rows = [
        f"{x:.7f} {y:.7f} {z:.7f} {r} {g} {b}"
        for (x, y, z), (r, g, b) in zip(garment.worn_pos.tolist(), colours.tolist(), strict=True)
    ]
    rows += [f"3 {a} {b} {c}" for a, b, c in garment.faces.tolist()]
    path.write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")
