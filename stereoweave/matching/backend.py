"""Choice of network, threads and execution provider for matching."""

import functools
import threading
from dataclasses import dataclass
from pathlib import Path

from stereoweave.matching.matcher import Matcher, model_file
from stereoweave.matching.providers import CPU, check_provider
from stereoweave.system.threads import thread_count


@dataclass(frozen=True, kw_only=True)
class Backend:
    """A network and its settings; each process loads the network once.

    Attributes:
        model: Name of a shipped network, `best`, or the path of an .onnx matcher file.
        threads: Maximum number of threads per call; default: all cores.
        provider: Execution provider, a name in `providers.PROVIDERS`.
    """

    model: str | Path = "small"
    threads: int | None = None
    provider: str = CPU

    def matcher(self) -> Matcher:
        """Load the network, or return the cached one if its file is unchanged.

        Raises:
            StereoweaveError: The number of threads is invalid.
            MatcherError: The model is unknown or invalid, or the provider is unavailable.
        """
        self._check_settings()
        path = model_file(self.model).absolute()
        with _LOADING:
            return _load(self, path, path.stat().st_mtime_ns)

    def check(self) -> None:
        """Check that the network can be loaded, without keeping it in memory.

        Raises the same errors as `matcher`.
        """
        self._check_settings()
        Matcher(self.model, threads=self.threads, provider=self.provider)

    def pin(self) -> "PinnedBackend":
        """Load the network, and return a backend that ignores later changes to its file.

        Raises the same errors as `matcher`.
        """
        return PinnedBackend(
            model=self.model, threads=self.threads, provider=self.provider, pinned=self.matcher()
        )

    def _check_settings(self) -> None:
        check_provider(self.provider)
        thread_count(self.threads)


@dataclass(frozen=True, kw_only=True)
class PinnedBackend(Backend):
    """A backend that keeps its loaded network; see `Backend.pin`."""

    pinned: Matcher

    def matcher(self) -> Matcher:
        """Return the pinned network."""
        return self.pinned


# Without a lock, each of several concurrent calls would load the network, because lru_cache does not wait.
_LOADING = threading.Lock()


@functools.lru_cache(maxsize=4)
def _load(backend: Backend, path: Path, modified_ns: int) -> Matcher:
    # path and modified_ns only distinguish cache entries: a relative path may later name another file.
    return Matcher(backend.model, threads=backend.threads, provider=backend.provider)
