"""The processes that train one network together: the ranks that torchrun started, or this process alone."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from stereoweave.errors import StereoweaveError
from stereoweave.system.threads import usable_cores

# Delay of a secondary error: time for the rank that failed first to exit, upon which torchrun ends all ranks.
_PATIENCE_S = 20.0


@dataclass(frozen=True)
class ProcessRank:
    """This process's rank, and the number of ranks in all and on this machine."""

    rank: int = 0
    world_size: int = 1
    local_world_size: int = 1

    def own_micro_batches(self, count: int) -> range:
        """Indices of this rank's micro-batches among the `count` of a step; ranks do not overlap."""
        own = count // self.world_size
        return range(self.rank * own, (self.rank + 1) * own)


def read_rank() -> ProcessRank:
    """Read the rank that torchrun gave this process. Without torchrun: rank 0 of 1."""
    if "TORCHELASTIC_RUN_ID" not in os.environ:
        return ProcessRank()
    return ProcessRank(*(int(os.environ[name]) for name in ("RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE")))


@contextmanager
def report_once() -> Iterator[None]:
    """Report an error once: from rank 0 if it occurs in every rank.

    Errors of the other ranks, and connection errors of rank 0, leave the block 20 s later. By then torchrun
    has usually ended the process because of the rank that failed first.
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
    """Threads for this process: an equal share of the machine's cores; None to keep PyTorch's choice.

    None in a single process, and where OMP_NUM_THREADS is above 1. A value of 1 is what torchrun sets by
    default, however many cores there are, so it does not count as a choice.
    """
    here = read_rank().local_world_size
    if here == 1 or os.environ.get("OMP_NUM_THREADS", "1") != "1":
        return None
    return max(1, usable_cores() // here)
