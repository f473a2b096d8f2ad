"""Loading a body by name or by path."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hood.assets.body.body import Body
from hood.assets.body.model_file import choose_model, read_model
from hood.assets.body.smpl_family import smpl_family_body
from hood.assets.files.library import locate


def load_body(name: str | Path = "default", gender: str | None = None) -> Body:
    """A body model by its embedded name or from a file.

    Files of the SMPL family with pose blend shapes are evaluated through ``smplx``.

    Args:
        name: the embedded ``default``, a body model file (``.npz``, official ``.pkl``), or a folder of them.
        gender: "neutral", "male" or "female": which model of a folder; None means neutral.

    Returns:
        The :class:`Body`, with ``v_template`` (W, 3) m in T-pose, ``faces`` (G, 3).

    Raises:
        FileNotFoundError: unknown name or missing file.
        ValueError: not a body model; names the file, the key and the fix.

    Examples:
        >>> import hood
        >>> body = hood.load_body()
        >>> body.v_template.shape, body.num_joints
        ((6890, 3), 24)
    """
    path = locate("body", name, folders=True)
    if path.is_dir():
        path = choose_model(path, gender)
    arrays = read_model(path)
    if "posedirs" in arrays and np.any(arrays["posedirs"]):
        return smpl_family_body(path, arrays)
    weights = arrays["weights"]
    return Body(
        name=path.stem,
        v_template=arrays["v_template"],
        shapedirs=arrays["shapedirs"],
        joint_regressor=arrays["J_regressor"],
        weights=weights / weights.sum(axis=1, keepdims=True),
        parents=tuple(int(parent) for parent in arrays["kintree_table"][0]),
        faces=arrays["f"],
    )
