"""Parts of a body by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hood.assets.body.body import JOINTS, Body, body_part


def part(name: str, body: Body) -> np.ndarray:
    return body_part(name, body.faces, len(body.v_template), body)


def test_joints_share_out_the_body(body: Body) -> None:
    left, right = (part(f"{side}_knee", body) for side in ("left", "right"))
    assert not (left & right).any()
    centres = body.v_template[body.faces].mean(axis=1)
    assert centres[left][:, 0].mean() > 0.02 > -0.02 > centres[right][:, 0].mean()
    assert 0.02 < left.mean() < 0.2


def test_above_and_below_are_all(body: Body) -> None:
    above, below = part("above_pelvis", body), part("below_pelvis", body)
    assert (above ^ below).all()
    height = body.v_template[body.faces].mean(axis=1)[:, 1]
    assert height[above].min() >= height[below].max()


def test_lists_are_of_vertices(body: Body, tmp_path: Path) -> None:
    few = tmp_path / "few.txt"
    few.write_text(" ".join(map(str, body.faces[:5].ravel())))
    assert body_part(str(few), body.faces, len(body.v_template), None)[:5].all()
    few.write_text(f"1 {len(body.v_template)}")
    with pytest.raises(ValueError, match=rf"few.txt: vertex {len(body.v_template)} of {len(body.v_template)} of the body"):
        part(str(few), body)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("left_wirst", "unknown joint 'left_wirst': did you mean 'left_wrist'"),
        ("above_navel", "unknown joint 'navel'"),
        ("torso", "above_JOINT, below_JOINT, or a list of vertices"),
    ],
)
def test_what_is_no_part_is_told(name: str, message: str, body: Body) -> None:
    with pytest.raises(ValueError, match=message):
        part(name, body)
    assert len(JOINTS) == 22


def test_without_joints_a_list_is_asked_for(body: Body) -> None:
    with pytest.raises(ValueError, match="has no joints; give a .txt or .json list"):
        body_part("left_knee", body.faces, len(body.v_template), None)
