"""The kernels of conjugate gradients compiled for three generations of GPUs, without one."""

import warnings

import pytest

from hood.tensors.conjugate_gradients import CHUNK, TILE, WARPS
from tests.spills import CAPABILITIES, LEAST, spilled

pytest.importorskip("triton", reason="Triton is built for Linux only")

ARGUMENTS = {
    **dict.fromkeys(("number", "tiles", "scenes"), "i32"),
    **dict.fromkeys(("columns", "starts", "tile_rows", "tile_ends", "tile_scene", "scene_tiles"), "*i32"),
    **dict.fromkeys(("stopped", "indefinite"), "*i32"),
}


@pytest.mark.parametrize("capability", CAPABILITIES)
@pytest.mark.parametrize("real", ["*fp64", "*fp32"])
def test_registers_suffice(real, capability, tmp_path, monkeypatch):
    from hood.tensors import cg_kernels

    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path / "cache"))
    kernels = {name: getattr(cg_kernels, name) for name in ("begin_pass", "product_pass", "update_pass")}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = {
            name: spilled(
                kernel,
                {key: ARGUMENTS.get(key, real) for key in kernel.arg_names},
                {"TILE": TILE, "CHUNK": CHUNK},
                {"num_warps": WARPS},
                capability,
                tmp_path,
            )
            for name, kernel in kernels.items()
        }
    assert max(found.values()) <= LEAST, found
