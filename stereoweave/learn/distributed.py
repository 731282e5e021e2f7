"""The processes that train one network together: torchrun's, or this one alone."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from stereoweave.errors import StereoweaveError
from stereoweave.system.threads import usable_cores

# How long a process waits with an error for another one to tell it, by which torchrun ends them all.
_PATIENCE_S = 20.0


@dataclass(frozen=True)
class ProcessRank:
    """Which of the processes this is, how many there are, and how many of them on this machine."""

    rank: int = 0
    world_size: int = 1
    local_world_size: int = 1

    def own_micro_batches(self, count: int) -> range:
        """Those of so many micro-batches that this process makes: neighbours, and nobody else's."""
        own = count // self.world_size
        return range(self.rank * own, (self.rank + 1) * own)


def read_rank() -> ProcessRank:
    """As torchrun started this process; one process alone where it did not."""
    if "TORCHELASTIC_RUN_ID" not in os.environ:
        return ProcessRank()
    return ProcessRank(*(int(os.environ[name]) for name in ("RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE")))


@contextmanager
def report_once() -> Iterator[None]:
    """An error leaves the block in one process alone: in the first one, where all of them have it.

    The others wait until torchrun ends them for that, and so does the first one where it only finds that
    another one is gone. An error that is theirs alone leaves it a little later.
    """
    try:
        yield
    except Exception as error:
        own = read_rank()
        to_tell = isinstance(error, StereoweaveError | OSError)
        if own.rank > 0 or (own.world_size > 1 and not to_tell):
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
