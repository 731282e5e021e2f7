"""Device, process group under torchrun, and memory of a training process."""

import atexit
import ctypes
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import Literal

import torch
from lightning_fabric import Fabric
from lightning_fabric.loggers.tensorboard import TensorBoardLogger
from lightning_fabric.strategies.ddp import DDPStrategy
from lightning_fabric.utilities.distributed import _destroy_dist_connection
from torch.distributed.distributed_c10d import PrefixStore
from torch.distributed.rendezvous import rendezvous

from stereoweave.errors import StereoweaveError
from stereoweave.learn.distributed import ProcessRank, choose_thread_count, read_rank

# The other ranks wait while rank 0 makes pairs or validates. If rank 0 dies, torchrun stops them.
_TIMEOUT = timedelta(days=1)


def make_fabric(logger: TensorBoardLogger) -> Fabric:
    """Set up this rank's device and, under torchrun, its process group."""
    own = read_rank()
    if own.world_size == 1:
        return Fabric(accelerator="auto", devices=1, precision=_choose_precision(), loggers=logger)
    cuda = torch.cuda.is_available()
    if cuda and own.local_world_size > torch.cuda.device_count():
        raise StereoweaveError(
            f"torchrun: expected at most one process per GPU, found {own.local_world_size} processes for "
            f"{torch.cuda.device_count()} GPUs; start fewer with --nproc-per-node"
        )
    if (threads := choose_thread_count()) and not cuda:
        torch.set_num_threads(threads)
    if own.rank > 0:
        logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
    fabric = Fabric(
        accelerator="cuda" if cuda else "cpu",
        devices=own.local_world_size,
        num_nodes=own.world_size // own.local_world_size,
        strategy=DDPStrategy(timeout=_TIMEOUT),
        precision=_choose_precision(),
        loggers=logger,
    )
    if own.world_size == own.local_world_size > 1:
        _join_ranks(own, "nccl" if cuda else "gloo")
    fabric.launch()
    return fabric


@contextmanager
def skip_teardown_on_error() -> Iterator[None]:
    """Skip the teardown of the process group after an error, so that this process exits at once.

    NCCL's teardown waits for all ranks, which in turn wait for this one on their GPUs.
    """
    try:
        yield
    except BaseException:
        atexit.unregister(_destroy_dist_connection)
        raise


def keep_freed_memory() -> None:
    """Make glibc keep large freed blocks, because requesting memory from the kernel slows down every step."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        m_trim_threshold, m_top_pad, m_mmap_max = -1, -2, -4
        mallopt(m_mmap_max, 0)
        mallopt(m_trim_threshold, 2**31 - 1)
        mallopt(m_top_pad, 2**28)


def _join_ranks(own: ProcessRank, backend: str) -> None:
    """Join the ranks that torchrun started together on this machine.

    torchrun reuses one store for all restarts. Without a prefix per restart, new ranks find the addresses of
    killed ranks and wait for them (PyTorch issue 135712).
    """
    store, rank, count = next(rendezvous("env://", own.rank, own.world_size))
    prefix = f"start {os.environ['TORCHELASTIC_RESTART_COUNT']}"
    torch.distributed.init_process_group(
        backend,
        store=PrefixStore(prefix, store),
        rank=rank,
        world_size=count,
        timeout=_TIMEOUT,
    )


def _choose_precision() -> Literal["bf16-mixed", "32-true"]:
    """Return bfloat16 mixed precision if the device supports it natively, else float32."""
    if torch.accelerator.is_available():
        computes = torch.cuda.is_bf16_supported()
    else:
        one_dnn = torch.backends.mkldnn.is_available()  # type: ignore[no-untyped-call]
        computes = one_dnn and torch.cpu.get_capabilities().get("avx512_bf16", False)
    return "bf16-mixed" if computes else "32-true"
