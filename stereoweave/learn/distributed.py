"""Distributed training of one network by the ranks that torchrun started, or by this process alone."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from stereoweave.errors import StereoweaveError
from stereoweave.system.threads import usable_cores

# Delay of errors that another rank's failure may have caused: when that rank exits, torchrun stops the rest.
_PATIENCE_S = 20.0


@dataclass(frozen=True)
class ProcessRank:
    """Rank of this process, and the number of ranks in total and on this machine."""

    rank: int = 0
    world_size: int = 1
    local_world_size: int = 1

    def own_micro_batches(self, count: int) -> range:
        """Return the indices of this rank's share of `count` micro-batches. Shares do not overlap."""
        own = count // self.world_size
        return range(self.rank * own, (self.rank + 1) * own)


def read_rank() -> ProcessRank:
    """Read the rank that torchrun assigned to this process; without torchrun, it is rank 0 of 1."""
    if "TORCHELASTIC_RUN_ID" not in os.environ:
        return ProcessRank()
    return ProcessRank(*(int(os.environ[name]) for name in ("RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE")))


@contextmanager
def report_once() -> Iterator[None]:
    """Report an error only once, from rank 0 if it occurs in every rank.

    The other ranks, and rank 0 after a connection error, wait for 20 s before the error leaves the block. By
    then, torchrun has usually stopped these processes, because another rank failed first.
    """
    try:
        yield
    except Exception as error:
        own = read_rank()
        own_error = isinstance(error, StereoweaveError | OSError)
        if own.rank > 0 or (own.world_size > 1 and not own_error):
            time.sleep(_PATIENCE_S)
        raise


def choose_thread_count() -> int | None:
    """Return this process's number of threads, an equal share of the cores; None for PyTorch's default.

    The result is None in a single process, or if OMP_NUM_THREADS is above 1. A value of 1 does not count as
    the user's choice, because torchrun sets it by default on any machine.
    """
    here = read_rank().local_world_size
    if here == 1 or os.environ.get("OMP_NUM_THREADS", "1") != "1":
        return None
    return max(1, usable_cores() // here)
