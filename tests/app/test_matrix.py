"""Every source of a body with every style of motion and garments made in every pose: a rollout, or one sentence.

What starts has no vertex deeper than 2 mm in the body and no edge stretched by more than 10% in its first frame, before the
network has a say, and runs.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from workshop import Workshop

from hood.assets.garment.binding import signed_distances
from hood.cli.main import main
from hood.mesh import topology
from hood.rollouts.file.reader import read_rollout

MODELS = ("default", "smpl_pickle", "smpl_npz", "smplh_npz", "smplx_npz")
MESHES = ("folder", "verts_npz", "verts_h5", "mesh_pickle", "gltf_skin", "gltf_morph", "still")
BODIES = (*MODELS, *MESHES, "none")
MOTIONS = ("amass_smplh", "amass_smplx", "pose_pickle", "vto", "none")
POSES = ("tpose", "apose", "posed")
FRAMES = 10
STRETCH, DEPTH = 0.10, 2e-3
QUIET = ("video=none", "sheet=false", "metrics=none")
#: For what is run often: figures are of the start, which no network has touched. The rest runs with the shipped model.
UNTRAINED = ("checkpoint=untrained", "model=small", "model.latent_dim=4", "model.schedule='1x(mesh)'")


class Case(NamedTuple):
    body: str
    motion: str
    pose: str
    garment: str = "tshirt"


PRODUCT = [Case(*names) for names in itertools.product(BODIES, MOTIONS, POSES)]


def refusal(case: Case) -> str | None:
    """The sentence for a combination that cannot be performed; None for the others.

    A model needs a motion, and a garment can be bound to it from any pose. A mesh performs its own motion, and its garment
    is given as it is worn in the first frame, or around the rest pose of a skin. Without a body a garment hangs anywhere.
    """
    if case.body in MODELS:
        return r"sequence=none; give a motion" if case.motion == "none" else None
    if case.motion != "none":
        return r"sequence=\S+\.(npz|pkl): body=\S+ (performs its own motion|does not move); leave sequence out"
    worn = {"none": POSES, "still": ("tpose",), "gltf_skin": ("tpose", "posed")}.get(case.body, ("posed",))
    if case.pose in worn:
        return None
    return rf"garment '{case.garment}_{case.pose}': (not worn by|passes through) '\w+' in (its first frame|frame 0).* give "


VALID = [case for case in PRODUCT if refusal(case) is None]
INVALID = [case for case in PRODUCT if refusal(case) is not None]
#: Each body, each motion and each pose at least once, models from other poses than the T-pose as well.
FEW_VALID = [
    Case("default", "amass_smplx", "tpose"), Case("smpl_pickle", "pose_pickle", "apose"), Case("smpl_npz", "vto", "tpose"),
    Case("smplh_npz", "amass_smplh", "tpose"), Case("smplx_npz", "amass_smplx", "posed"), Case("none", "none", "apose"),
    Case("still", "none", "tpose"), Case("gltf_skin", "none", "tpose"),
    *(Case(body, "none", "posed") for body in MESHES if body not in ("still", "gltf_skin")),
]  # fmt: skip
FEW_INVALID = [
    Case("default", "none", "tpose"), Case("folder", "vto", "posed"), Case("still", "amass_smplh", "tpose"),
    Case("none", "pose_pickle", "tpose"), Case("still", "none", "apose"), Case("verts_npz", "none", "tpose"),
]  # fmt: skip


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Workshop:
    return Workshop(tmp_path_factory.mktemp("workshop"))


def words_of(case: Case, workshop: Workshop, folder: Path) -> list[str]:
    """The words of ``hood rollout``; what was made in another pose than a model's T-pose is prepared first."""
    garment, motion = workshop.garment(case.garment, case.pose), workshop.motion(case.motion)
    if case.body in MODELS and case.pose != "tpose" and case.motion != "none":
        pose = ["pose=auto"] if case.pose == "apose" else [f"pose={motion}", "frame=0"]
        prepared = str(folder / "prepared.npz")
        assert main(["prepare", f"garment={garment}", f"body={workshop.body(case.body)}", f"output={prepared}", *pose]) == 0
        garment = prepared
    body = workshop.body(case.body)
    return [f"garment={garment}", f"body={body}", f"sequence={motion}", f"num_frames={FRAMES}", f"output={folder / 'out'}"]


def start_figures(folder: Path) -> tuple[float, float]:
    """Greatest stretch of an edge and depth [m] of a vertex in frame 0, from what was written."""
    data = read_rollout(folder / "out" / "rollout.h5")
    assert data.cloth_pos.shape[0] == FRAMES
    assert np.isfinite(data.cloth_pos).all()
    edges = topology.unique_edges(data.cloth_faces)
    length, rest = (np.linalg.norm(pos[edges[:, 1]] - pos[edges[:, 0]], axis=1) for pos in (data.cloth_pos[0], data.rest_pos))
    if not data.body_pos.shape[1]:
        return float((length / rest - 1).max()), 0.0
    dist = signed_distances(data.cloth_pos[0].astype(np.float64), data.body_pos[0].astype(np.float64), data.body_faces)
    return float((length / rest - 1).max()), float(max(-dist.min(), 0.0))


def check_valid(case: Case, workshop: Workshop, folder: Path, *options: str) -> None:
    # The garment as it is put on is judged: its own weight stretches a shoulder further, by up to a seventh.
    assert main(["rollout", *words_of(case, workshop, folder), *QUIET, "settle=paper", *options]) == 0
    stretch, depth = start_figures(folder)
    assert stretch <= STRETCH
    assert depth <= DEPTH
    print(f"start: edges stretched by at most {100 * stretch:.1f}%, deepest vertex {1e3 * depth:.2f} mm")  # pytest -rP


def check_invalid(case: Case, workshop: Workshop, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = words_of(case, workshop, folder)
    capsys.readouterr()
    assert main(["rollout", *words, *QUIET]) == 2
    said = capsys.readouterr().err.strip()
    assert said.count("\n") == 0
    expected = refusal(case)
    assert expected is not None
    with pytest.raises(ValueError, match=expected):
        raise ValueError(said)


def name_of(case: Case) -> str:
    return "-".join(case[:3])


def test_the_product_has_both_kinds() -> None:
    assert (len(PRODUCT), len(VALID), len(INVALID)) == (195, 71, 124)
    assert set(FEW_VALID) <= set(VALID)
    assert set(FEW_INVALID) <= set(INVALID)
    for position, names in enumerate((BODIES, MOTIONS, POSES)):
        assert {case[position] for case in FEW_VALID} == set(names)


@pytest.mark.parametrize("case", FEW_VALID, ids=name_of)
def test_a_rollout(case: Case, workshop: Workshop, tmp_path: Path) -> None:
    check_valid(case, workshop, tmp_path, *UNTRAINED, "fail_on=nothing")


@pytest.mark.parametrize("case", FEW_INVALID, ids=name_of)
def test_one_sentence(case: Case, workshop: Workshop, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    check_invalid(case, workshop, tmp_path, capsys)


def others(cases: Sequence[Case], few: Sequence[Case], garments: Sequence[str]) -> list[Case]:
    """The rest of the product, with garments in turn."""
    rest = [case for case in cases if case not in few]
    return [case._replace(garment=garments[number % len(garments)]) for number, case in enumerate(rest)]


@pytest.mark.slow
@pytest.mark.parametrize("case", others(VALID, FEW_VALID, ("longsleeve", "trousers", "dress", "tshirt")), ids=name_of)
def test_every_rollout(case: Case, workshop: Workshop, tmp_path: Path) -> None:
    check_valid(case, workshop, tmp_path)


# Garments with sleeves: others fit a T-pose and an A-pose alike.
@pytest.mark.slow
@pytest.mark.parametrize("case", others(INVALID, FEW_INVALID, ("longsleeve", "tshirt")), ids=name_of)
def test_every_sentence(case: Case, workshop: Workshop, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    check_invalid(case, workshop, tmp_path, capsys)
