"""Several processes, started by torchrun on one machine or many: gradients averaged by DDP, work shared by rank."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Mapping
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

Result = TypeVar("Result")

#: How long a process waits for the others. Shares of a batch of rollouts may differ by hours; updates of a training take
#: as long on every process.
BATCH_TIMEOUT, TRAINING_TIMEOUT = timedelta(days=7), timedelta(hours=1)
_TOLD = "raised on process 0"


def start(timeout: timedelta = BATCH_TIMEOUT) -> None:
    """Join the process group when torchrun started this process; otherwise do nothing. A process that waits longer than
    ``timeout`` for the others ends with an error."""
    if "WORLD_SIZE" in os.environ and int(os.environ["WORLD_SIZE"]) > 1 and not dist.is_initialized():
        # Flags and slots are exchanged on the CPU in any case, gradients where the model is.
        backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
        dist.init_process_group(backend, timeout=timeout)


def stop() -> None:
    """Leave the process group."""
    if dist.is_initialized():
        dist.destroy_process_group()


def rank() -> int:
    """Number of this process, 0 when alone."""
    return dist.get_rank() if dist.is_initialized() else 0


def is_first() -> bool:
    """Whether this is process 0, also before it has joined the others."""
    return int(os.environ.get("RANK", "0")) == 0 if not dist.is_initialized() else rank() == 0


def local_world_size() -> int:
    """Number of processes on this machine, 1 when alone; also before they have joined."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", "1"))


def local_rank() -> int:
    """Number of this process on this machine, 0 when alone; also before it has joined the others."""
    return int(os.environ.get("LOCAL_RANK", "0"))


def world_size() -> int:
    """Number of processes, 1 when alone."""
    return dist.get_world_size() if dist.is_initialized() else 1


def any_rank(flag: bool) -> bool:
    """Whether any process raised its flag; all processes get the same answer."""
    if world_size() == 1:
        return flag
    value = torch.tensor(int(flag))
    dist.all_reduce(value, op=dist.ReduceOp.MAX)
    return bool(value)


def gather(value: Any) -> list[Any]:
    """The processes' values in rank order, on every process."""
    if world_size() == 1:
        return [value]
    values: list[Any] = [None] * world_size()
    dist.all_gather_object(values, value)
    return values


def on_main(function: Callable[[], Result]) -> Result:
    """What ``function`` returns on process 0, on every process; what it raises there is raised on all of them.

    Files are written, and read where no file system is shared, in one place; no process waits for one that gave up.
    """
    outcome: list[Any] = [None, None]
    if rank() == 0:
        try:
            outcome[0] = function()
        except (ValueError, OSError, ImportError) as error:
            outcome[1] = error
    if world_size() > 1:
        dist.broadcast_object_list(outcome, src=0, device=torch.device("cpu"))
    if outcome[1] is not None:
        if rank() != 0:
            outcome[1].add_note(_TOLD)
        raise outcome[1]
    result: Result = outcome[0]
    return result


def is_told(error: BaseException) -> bool:
    """Whether an error came from process 0, which tells it itself."""
    return _TOLD in getattr(error, "__notes__", ())


def mean(report: Mapping[str, float]) -> dict[str, float]:
    """Entry-wise mean over the processes; an entry that a process lacks (an energy its scenes do not have) counts as 0."""
    reports = gather(dict(report))
    names = dict.fromkeys(name for part in reports for name in part)
    return {name: sum(part.get(name, 0.0) for part in reports) / len(reports) for name in names}


def averaging(module: torch.nn.Module) -> DistributedDataParallel:
    """The module with gradients that are means over the processes; its buffers are left alone from then on."""
    known = inspect.signature(DistributedDataParallel).parameters
    key = "forward_sync_buffers" if "forward_sync_buffers" in known else "broadcast_buffers"  # torch before 2.13
    return DistributedDataParallel(module, **{key: False})  # type: ignore[arg-type]


def all_reduce_sum(value: Tensor) -> Tensor:
    """Sum over the processes, in place; what each of them gets is the same to the last bit."""
    dist.all_reduce(value)
    return value
