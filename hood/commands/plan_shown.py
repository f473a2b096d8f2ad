"""What the page of ``hood plan`` shows besides its table: facts of the mesh, and the cloth with and without parts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hood.assets.files.library import names
from hood.commands.setup import Setup
from hood.dynamics.captured import network_of
from hood.evaluation.leaving_out import Begun, Effect
from hood.media.plan_page import SHOWN, Difference, write_page
from hood.scene.cloth import Cloth

#: Nine tenths of what a push does in one step is felt within so many times the way of a wave.
_FELT = 2.9


def facts(ready: Setup) -> dict[str, Any]:
    """Of the mesh, its fabric and the network: numbers that say what they can show."""
    cloth, network = ready.scene.cloth, network_of(ready.stepper)
    edge = float((cloth.rest_pos[cloth.edges[:, 0]] - cloth.rest_pos[cloth.edges[:, 1]]).norm(dim=1).mean())
    return {
        "vertices": cloth.num_vertices,
        "edge_mm": 1e3 * edge,
        "influence_edges": _FELT * wave_speed(cloth) * ready.scene.dt / edge,
        "levels": None if network is None else network.num_coarse,
        "finer": _finer(str(ready.config.garment)),
    }


def wave_speed(cloth: Cloth) -> float:
    """Speed [m/s] of waves in the plane of the cloth, √((λ + 2 μ) h / ρ), of its mean fabric along the stiffer thread."""
    stiffness = (cloth.lame_lambda + 2.0 * cloth.lame_mu) * cloth.thickness
    if cloth.weave is not None:
        stiffness = stiffness * cloth.weave[:, :2].amax(dim=1)
    density = cloth.mass.sum() / cloth.rest_area.sum()
    return float((torch.as_tensor(stiffness).double().mean() / density.double()).sqrt())


def _finer(garment: str) -> list[str]:
    """Embedded meshes of the same garment that are finer: ``dress_4k`` of ``dress``."""
    sizes = [name for name in names("garments") if name.startswith(f"{garment.partition('_')[0]}_")]
    known = {name: int(name.rpartition("_")[2].rstrip("k")) for name in sizes}
    own = known.get(garment, 0 if garment in names("garments") else 1 << 30)
    return sorted((name for name, size in known.items() if size > own), key=known.__getitem__)


def differences(ready: Setup, begun: Sequence[Begun], effects: Mapping[str, Effect], frames: int) -> list[Difference]:
    """The largest ones of all parts, each in its worst window."""
    found, scene = [], ready.scene
    for name, effect in effects.items():
        finite = [mm if np.isfinite(mm) else -1.0 for mm in effect.mm]
        worst = int(np.argmax(finite))
        if not name or finite[worst] <= 0.0:
            continue
        frame = begun[worst].frame + frames
        origin = np.asarray(scene.motion.translation[frame], dtype=np.float64)
        body = scene.motion.surface(frame, origin).cpu().double().numpy() + origin
        full, without = (one.last[worst].numpy() for one in (effects[""], effect))
        surfaces = full, without, scene.garment.faces, body, scene.motion.faces
        found.append(Difference(name, frame, finite[worst], *surfaces))
    return sorted(found, key=lambda one: -one.mm)[:SHOWN]


def show(path: Path, plan: Mapping[str, Any], sentence: str, shown: Sequence[Difference]) -> str:
    """Write the page; a line on it. Without the picture libraries it has no pictures."""
    try:
        write_page(path, plan, sentence, shown)
    except ImportError as error:
        write_page(path, plan, sentence, [])
        return f"page in {path}, without pictures: {error}"
    return f"page in {path}"
