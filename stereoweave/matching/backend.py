"""What pairs are matched with: a network, its threads and its provider."""

import functools
from dataclasses import dataclass
from pathlib import Path

from stereoweave.matching.matcher import Matcher, model_file
from stereoweave.matching.providers import CPU, check_provider
from stereoweave.system.threads import thread_count


@dataclass(frozen=True, kw_only=True)
class Backend:
    """A network and what runs it; a process loads each once.

    Attributes:
        model: Name of a shipped network, `best`, or path of an .onnx matcher.
        threads: Threads that a call may use; default: all cores.
        provider: What the network runs on, a name in `providers.PROVIDERS`.
    """

    model: str | Path = "small"
    threads: int | None = None
    provider: str = CPU

    def matcher(self) -> Matcher:
        """The loaded network; it is loaded again if its file has changed.

        Raises:
            StereoweaveError: The number of threads is invalid.
            MatcherError: The model is unknown or invalid, or the provider is unavailable.
        """
        check_provider(self.provider)
        thread_count(self.threads)
        path = model_file(self.model).absolute()
        return _load(self, path, path.stat().st_mtime_ns)


@functools.lru_cache(maxsize=4)
def _load(backend: Backend, path: Path, modified_ns: int) -> Matcher:
    # The last two are part of the key alone: a relative path may have become another file's.
    return Matcher(backend.model, threads=backend.threads, provider=backend.provider)
