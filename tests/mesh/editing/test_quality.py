import numpy as np
import pytest

from hood.mesh.editing.quality import check_triangles
from hood.testing import cylinder, grid

POS, FACES = grid(3, 3)


def edited(row, values, faces=FACES):
    faces = faces.copy()
    faces[row] = values
    return faces


def test_legal_meshes_pass():
    check_triangles(POS, FACES, "sheet")
    check_triangles(np.concatenate([POS, POS[:2] + 5]), FACES, "isolated vertices")
    check_triangles(np.concatenate([POS, [[0.5, 1, 0.5]]]), np.concatenate([FACES, [[0, 3, 9]]]), "three faces at an edge")
    tube = cylinder()
    check_triangles(np.concatenate([POS, tube[0]]), np.concatenate([FACES, tube[1] + 9]), "two components")
    check_triangles(POS.astype(np.float32), FACES.astype(np.int32)[:, ::-1], "flipped")
    check_triangles(POS * np.array([1, 1, 1e-6]), FACES, "slivers")


@pytest.mark.parametrize(
    ("pos", "faces", "words"),
    [
        (POS[:0], FACES, ["empty"]),
        (POS, FACES[:0], ["empty"]),
        (POS[:, :2], FACES, ["(9, 2)", "(num_vertices, 3)"]),
        (POS, np.array([[0, 1, 4, 3]]), ["4 corners", "triangles"]),
        (POS, FACES.astype(np.float64), ["float64", "integers"]),
        (POS, edited(5, [0, 1, 9]), ["face 5", "9"]),
        (POS, edited(2, [0, -1, 3]), ["face 2", "-1"]),
        (POS, edited(3, [4, 1, 4]), ["face 3", "repeats", "remove"]),
        (POS, edited(6, FACES[1][[1, 2, 0]]), ["face 6", "duplicates face 1"]),
        (POS, edited(4, [0, 1, 2]), ["face 4", "zero rest area", "merge"]),
        (np.where(np.arange(9)[:, None] == 7, np.nan, POS), FACES, ["vertex 7", "finite"]),
        (np.where(np.arange(9)[:, None] == 2, np.inf, POS), FACES, ["vertex 2", "finite"]),
    ],
)
def test_refusal_names_the_mesh_the_element_and_the_fix(pos, faces, words):
    with pytest.raises(ValueError) as error:
        check_triangles(pos, faces, "garment 'dress'")
    message = str(error.value)
    assert message.startswith("garment 'dress'")
    for word in words:
        assert word in message
