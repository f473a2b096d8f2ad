"""``faults`` of ``summary.json``: first frame and numbers of what makes a rollout unsound, garment by garment."""

from __future__ import annotations

import json

import numpy as np

from hood.app.output.verdict import summarise_verdict
from hood.mesh.penetration.crossing import self_crossings
from hood.rollouts.file.reader import RolloutData

FRAMES, FROM, SIDE = 10, 6, 21
_AXIS = np.linspace(0.0, 1.0, SIDE)
SHEET = np.stack([*np.meshgrid(_AXIS, _AXIS, indexing="ij"), np.zeros((SIDE, SIDE))], axis=2).reshape(-1, 3)
_CELL = (np.arange(SIDE - 1)[:, None] * SIDE + np.arange(SIDE - 1)).reshape(-1, 1)
FACES = np.concatenate([_CELL + [0, SIDE, 1], _CELL + [SIDE, SIDE + 1, 1]])
COUNT = len(SHEET)
#: Upright, through the middle of the other one from frame FROM on.
UPRIGHT = SHEET[:, [0, 2, 1]] + [0.0, 0.512, -0.507]


def _outfit(pos: np.ndarray) -> RolloutData:
    """``pos`` (T, V, 3) of top and skirt, which both have the faces of the sheet."""
    faces = np.concatenate([FACES, FACES + COUNT])
    return RolloutData(
        cloth_pos=pos,
        cloth_faces=faces,
        rest_pos=pos[0],
        body_pos=np.zeros((FRAMES, 0, 3)),
        body_faces=np.zeros((0, 3), np.int64),
        time=np.arange(FRAMES) / 30.0,
        metrics={},
        attributes={"garment": "top+skirt", "dt": 1 / 30, "config": "{}"},
        still={"piece": np.repeat([0, 1], COUNT)},
    )


def _apart() -> np.ndarray:
    return np.concatenate([SHEET, UPRIGHT + [0.0, 0.0, 2.0]])[None].repeat(FRAMES, axis=0)


def test_stretched_edges_are_named_in_numbers_of_their_garment() -> None:
    pos = _apart()
    pos[FROM:, COUNT + 100 : COUNT + 200] += [3.0, 0.0, 0.0]
    summary = summarise_verdict(_outfit(pos))
    assert summary["sound"] is False
    (fault,) = [one for one in summary["faults"] if one["kind"] == "strain"]
    assert (fault["garment"], fault["first_frame"], fault["frames"]) == ("skirt", FROM, [[FROM, FRAMES - 1]])
    assert set(fault) == {"kind", "garment", "first_frame", "frames", "vertices", "fix"}
    moved = np.zeros(COUNT, bool)
    moved[100:200] = True
    ends = np.concatenate([FACES[:, [0, 1]], FACES[:, [1, 2]], FACES[:, [2, 0]]])
    torn = ends[moved[ends[:, 0]] != moved[ends[:, 1]]]
    assert set(fault["vertices"]) == set(torn.reshape(-1).tolist())
    json.dumps(summary["faults"])


def test_garments_through_each_other_are_named_both() -> None:
    pos = _apart()
    pos[FROM:, COUNT:] = UPRIGHT
    summary = summarise_verdict(_outfit(pos))
    crossed = [one for one in summary["faults"] if one["kind"] == "garments_through_each_other"]
    assert [one["garment"] for one in crossed] == ["top", "skirt"]
    assert {one["first_frame"] for one in crossed} == {FROM}
    pairs = self_crossings(pos[FROM], np.concatenate([FACES, FACES + COUNT]))
    below, above = (np.unique(np.sort(pairs, axis=1)[:, column]) for column in (0, 1))
    assert crossed[0]["triangles"] == below.tolist()
    assert crossed[1]["triangles"] == (above - len(FACES)).tolist()


def test_numbers_are_few_and_what_is_not_finite_is_named() -> None:
    pos = _apart()
    pos[FROM:, :300] = np.nan
    summary = summarise_verdict(_outfit(pos))
    (fault,) = [one for one in summary["faults"] if one["kind"] == "not_finite"]
    assert fault["garment"] == "top"
    assert fault["vertices"] == list(range(200))


def test_a_sound_rollout_has_none_and_a_doubt_says_what_helps() -> None:
    assert summarise_verdict(_outfit(_apart()))["faults"] == []
    pos = _apart()
    pos[:, COUNT:] = UPRIGHT + [0.87, 0.0, 0.0]  # a few pairs at the rim, from the start on
    summary = summarise_verdict(_outfit(pos))
    assert [doubt["kind"] for doubt in summary["doubts"]] == ["garment"]
    assert [one["kind"] for one in summary["faults"]] == ["garments_through_each_other"] * 2
    assert all(one["fix"].startswith("the file has them") and one["triangles"] for one in summary["faults"])
