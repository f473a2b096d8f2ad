"""Kernels, bytes and operations of a function, and the time that follows from them."""

import sys
from pathlib import Path

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from roofline import DATA_SHEETS, Device, Kernel, Work, WorkCounter


def counted() -> Work:
    x, weight, index = torch.ones(32), torch.ones(6, 8), torch.tensor([0, 1, 0])
    with WorkCounter() as counter:
        torch.addmm(torch.ones(6), x.view(4, 8), weight.t()).index_select(0, index).add(1.0)
    return counter.work


def test_kernels_bytes_and_operations():
    ones, product, gather, add = counted().kernels
    assert ones.name == "ones"
    assert product == Kernel("addmm", 4 * (6 + 32 + 48 + 24), 2 * 4 * 6 * 8, "matmul")
    assert gather == Kernel("index_select", 4 * (18 + 18) + 8 * 3, 18, "other")  # two rows of the four are read, one twice
    assert add == Kernel("add", 4 * (18 + 18), 18, "other")


def test_views_and_empty_arrays_are_no_kernels():
    with WorkCounter() as counter:
        torch.empty(4, 4).t()[:2].view(2, 4).unsqueeze(0).expand(3, 2, 4)
    assert not counter.work.kernels


def test_what_is_broadcast_is_read_once():
    with WorkCounter() as counter:
        torch.neg(torch.empty(1, 8).expand(100, 8))
    assert counter.work.bytes_moved == 4 * (8 + 800)


def test_values_play_no_role():
    with FakeTensorMode(), WorkCounter() as counter:
        torch.empty(3, 5, device="meta") @ torch.empty(5, 7, device="meta")
    assert counter.work.kernels == [Kernel("mm", 4 * (15 + 35 + 21), 2 * 3 * 5 * 7, "matmul")]


def test_a_kernel_takes_the_longest_of_gap_bytes_and_operations():
    device = Device("test", bandwidth=1e9, matmul={"fp32": 1e10, "bf16": 1e11}, arithmetic=1e9, launch=1e-5, replay=1e-6)
    work = Work([Kernel("a", 10, 10, "other"), Kernel("b", 10**6, 10, "other"), Kernel("c", 10, 10**8, "matmul")])
    assert work.bytes_moved == 10**6 + 20
    assert work.flops == 10**8 + 20
    assert device.seconds(work) == pytest.approx(1e-6 + 1e-3 + 1e-2)
    assert device.seconds(work, captured=False) == pytest.approx(1e-5 + 1e-3 + 1e-2)
    assert device.seconds(work, "bf16") == pytest.approx(1e-6 + 1e-3 + 1e-3)


def test_data_sheets_know_every_precision():
    for device in DATA_SHEETS.values():
        assert device.matmul["fp32"] < device.matmul["tf32"] < device.matmul["bf16"]
        assert device.replay < device.launch
