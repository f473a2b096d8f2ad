"""Compiled parts take as many numbers at a time as the registers of a processor hold; what they find is the same.

As a script this file computes a step with the libraries of a generation of processors and writes what came out.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from hood.native import build
from hood.native.build import Level, flags_for, levels, processor

OTHERS = [level for level in levels()[1:] if level.needs <= frozenset(processor().split())]


def found() -> dict[str, Tensor]:
    from hood.assets.body.load import load_body
    from hood.assets.garment.garment import load_garment
    from hood.assets.motion.load import load_sequence
    from hood.energies.potential import default_potential
    from hood.energies.problem import StepProblem
    from hood.mesh.penetration.crossing import crossings, self_crossings
    from hood.scene.scene import build_scene
    from hood.solver.newton import NewtonSettings, minimize

    garment, motion = load_garment("tank"), load_sequence("walk_proud", 30.0)
    scene = build_scene(garment, load_body(), motion, dtype=torch.float64)
    potential, state = default_potential(), scene.start(4)
    problem = potential.prepare(StepProblem(scene.cloth, state, scene.step_input(4, state)))
    contact = problem.contact
    assert contact is not None
    settings = NewtonSettings(max_iterations=3, engine="compiled")
    pos, report = minimize(potential, problem, settings=settings)
    sunk = state.pos - 0.02 * contact.normal  # into the skin, to be cut by it
    obstacle = problem.step.obstacle
    assert obstacle is not None
    faces = scene.cloth.faces.numpy()
    cut = crossings(sunk.numpy(), faces, obstacle.pos.numpy(), obstacle.faces.numpy())
    crumpled = state.pos.numpy() + np.random.default_rng(0).normal(scale=0.02, size=state.pos.shape)
    return {
        "nearest": contact.vertex,  # of two faces beside an edge a rounding decides
        "contact": torch.cat([contact.point, contact.normal, contact.next_normal, contact.curvature.unsqueeze(1)], dim=1),
        "cut": torch.as_tensor(cut.pairs),
        "crossed": torch.as_tensor(self_crossings(crumpled, faces)),
        "phi": report.phi,
        "pos": pos,
    }


def by(level: Level | None, folder: Path) -> dict[str, Tensor]:
    """What a process finds with libraries for a level; None: for this processor."""
    folder.mkdir()
    name, path = "native" if level is None else level.name, folder / "found.pt"
    environment = {**os.environ, "HOOD_CACHE": str(folder / "cache"), "OMP_NUM_THREADS": "1"}
    root = str(Path(__file__).parents[2])
    environment["PYTHONPATH"] = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    subprocess.run([sys.executable, "-P", __file__, name, str(path)], check=True, env=environment, timeout=300)
    return torch.load(path)


@pytest.fixture(scope="module")
def native(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Tensor]:
    return by(None, tmp_path_factory.mktemp("native") / "native")


@pytest.mark.parametrize("level", OTHERS, ids=lambda level: level.name)
def test_narrower_registers_find_the_same(level: Level, compiler: str, native: dict[str, Tensor], tmp_path: Path) -> None:
    other = by(level, tmp_path / "other")
    assert len(native["cut"]) > 10
    assert len(native["crossed"]) > 10
    for name in ("nearest", "cut", "crossed"):
        assert torch.equal(other[name], native[name])
    torch.testing.assert_close(other["contact"], native["contact"], rtol=0.0, atol=1e-11)
    torch.testing.assert_close(other["phi"], native["phi"], rtol=1e-9, atol=0.0)
    torch.testing.assert_close(other["pos"], native["pos"], rtol=0.0, atol=1e-7)


if __name__ == "__main__":
    if sys.argv[1] != "native":
        (chosen,) = [level for level in levels() if level.name == sys.argv[1]]
        build.NATIVE_FLAGS = tuple(flags_for(build.NATIVE_FLAGS, chosen))
    torch.set_num_threads(1)
    torch.save(found(), sys.argv[2])
