"""Mirror images: exact, their own inverse, outward where the original is."""

from __future__ import annotations

import numpy as np
import torch

from hood.assets.body.body import Body
from hood.assets.garment.binding import bind_garment
from hood.assets.garment.garment import Garment
from hood.assets.garment.mirror import mirror_body, mirror_garment, reflect
from hood.assets.motion.sequence import PoseSequence
from hood.mesh import geometry

BETAS = np.linspace(-2, 2, 10)


def test_a_mirrored_body_does_the_mirrored_motion(body: Body, walk: PoseSequence) -> None:
    window, image = walk.window(40, 50), mirror_body(body)
    assert torch.equal(image.surface(window, BETAS), reflect(body.surface(window, BETAS)))
    np.testing.assert_array_equal(image.translation(window, BETAS)[:, 0], -body.translation(window, BETAS)[:, 0])
    np.testing.assert_array_equal(image.translation(window, BETAS)[:, 1:], body.translation(window, BETAS)[:, 1:])
    # The posing of the image's own arrays, as of any body, agrees with the image of the posed original.
    own = Body.surface(image, window, BETAS, torch.float64)
    torch.testing.assert_close(own, image.surface(window, BETAS, torch.float64), rtol=0, atol=1e-12)


def test_normals_are_the_images_of_normals(body: Body) -> None:
    image = mirror_body(body)
    pos, faces = torch.as_tensor(body.v_template), torch.as_tensor(body.faces)
    normals = geometry.vertex_normals(torch.as_tensor(image.v_template), torch.as_tensor(image.faces))
    torch.testing.assert_close(normals, reflect(geometry.vertex_normals(pos, faces)), rtol=0, atol=1e-12)


def test_a_mirrored_garment_stays_bound_to_the_mirrored_body(body: Body, garments: dict[str, Garment]) -> None:
    garment = bind_garment(garments["shorts"], body)
    image = mirror_garment(garment)
    assert bind_garment(image, mirror_body(body)) is image
    np.testing.assert_array_equal(image.shaped(BETAS) * [-1, 1, 1], garment.shaped(BETAS))
    again = mirror_garment(image)
    np.testing.assert_array_equal(again.rest_pos, garment.rest_pos)
    np.testing.assert_array_equal(again.faces, garment.faces)
