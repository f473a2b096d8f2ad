"""The switch for TensorFloat-32, and who is refused it."""

from __future__ import annotations

import warnings

import pytest
import torch

from hood.app.common import warn_if_slow
from hood.model.kernels import block
from hood.model.network.model import MeshGraphNet
from hood.tensors.dense import check_precision, products

SWITCH = torch.backends.cuda.matmul


@pytest.mark.parametrize("before", ["none", "ieee", "tf32"])
def test_the_switch_goes_back_to_what_it_was(before: str) -> None:
    found = SWITCH.fp32_precision
    try:
        SWITCH.fp32_precision = before
        with products("tf32"):
            assert SWITCH.fp32_precision == "tf32"
        assert SWITCH.fp32_precision == before
        with pytest.raises(KeyError), products("tf32"):
            raise KeyError
        assert SWITCH.fp32_precision == before
        for name in ("fp32", "bf16"):
            with products(name):
                assert SWITCH.fp32_precision == before
    finally:
        SWITCH.fp32_precision = found


def test_who_is_refused() -> None:
    for name in ("fp32", "bf16"):
        check_precision(name, torch.device("cpu"))
    check_precision("tf32", torch.device("cuda"))
    check_precision("tf32")
    with pytest.raises(ValueError, match="precision=tf32 needs device=cuda, not cpu"):
        check_precision("tf32", torch.device("cpu"))
    with pytest.raises(ValueError, match="precision is 'half'; choose fp32, bf16 or tf32"):
        check_precision("half")


def test_a_network_refuses_it_on_a_cpu() -> None:
    network = MeshGraphNet(3, {"mesh": 2, "body": 2}, 4, "1x(mesh)")
    network.use_precision("tf32")
    with pytest.raises(ValueError, match="precision=tf32 needs device=cuda"):
        network(None, torch.zeros(1, 3), {})


@pytest.mark.parametrize(
    ("processor", "slow"),
    [
        ("Linux x86_64 flags : fpu sse2 avx2 avx512f", True),
        ("Linux x86_64 flags : fpu sse2 avx2 avx512f avx512_bf16", False),
        ("Linux x86_64 flags : fpu sse2 amx_bf16 amx_tile", False),
        ("Linux aarch64 Features : fp asimd bf16", False),
        ("Linux aarch64 Features : fp asimd", True),
        ("Darwin arm64 arm", False),  # what it can do is not known
    ],
)
def test_bfloat16_without_instructions_for_it_is_told(processor: str, slow: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(block, "processor", lambda: processor)
    cpu = torch.device("cpu")
    assert bool(block.why_slow("bf16", cpu)) == slow
    assert block.why_slow("fp32", cpu) == block.why_slow("bf16", torch.device("cuda")) == ""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        warn_if_slow("trainer.precision", "bf16", cpu)
    assert [str(one.message)[:75] for one in heard] == [
        "trainer.precision=bf16: this processor has no instructions for bfloat16 (AV"
    ] * slow
