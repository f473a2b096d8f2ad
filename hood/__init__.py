"""hood: learned clothing dynamics. One graph network dresses moving bodies (HOOD, CVPR 2023).

The names below are the public interface. They are imported when they are first used, so ``import hood`` loads no torch.

    import hood

    for frame in hood.simulate("dress", "plie", num_frames=60, progress=True):
        print(frame.index, frame.world_pos.shape)
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

#: Where each public name lives; ``__init__.pyi`` says the same to type checkers and editors.
_HOMES = {
    "simulate": "hood.api",
    "Simulation": "hood.api",
    "rollout": "hood.api",
    "dress": "hood.api",
    "differentiable": "hood.api",
    "step": "hood.rollouts.gradients",
    "fit": "hood.app.fit",
    "export": "hood.api",
    "view": "hood.app.output.view",
    "train": "hood.api",
    "load_model": "hood.api",
    "load_garment": "hood.assets.garment.garment",
    "load_body": "hood.assets.body.load",
    "load_sequence": "hood.assets.motion.load",
    "names": "hood.assets.files.library",
    "Garment": "hood.assets.garment.garment",
    "Body": "hood.assets.body.body",
    "PoseSequence": "hood.assets.motion.sequence",
    "BodyMesh": "hood.assets.motion.animated_mesh",
    "Material": "hood.assets.material",
    "FaceField": "hood.assets.material",
    "EdgeField": "hood.assets.material",
    "Scene": "hood.scene.scene",
    "build_scene": "hood.scene.scene",
    "Potential": "hood.energies.potential",
    "default_potential": "hood.energies.potential",
    "RolloutData": "hood.rollouts.file.reader",
    "read_rollout": "hood.rollouts.file.reader",
    "RolloutBatches": "hood.rollouts.file.batches",
    "RolloutDataset": "hood.rollouts.file.dataset",
    "load_reference_checkpoint": "hood.steppers.published",
}
__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> Any:
    """The public name ``name``, imported now."""
    if name not in _HOMES:
        raise AttributeError(f"module 'hood' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
