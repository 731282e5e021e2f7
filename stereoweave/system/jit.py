"""Compiler settings for the kernels (loops over pixels, compiled by Numba).

Compiled code is kept in the user's cache folder (`kernel_cache`), never in the package, because an
installation may be read-only. Kernels that process whole rows use float32 and no branches, so the compiler
can vectorise them and they run three times as fast.
"""

import functools
import typing
from collections.abc import Callable

from numba import config, njit, typeof

from stereoweave.system.kernel_cache import compile_once, kernels_folder

_SETTINGS: dict[str, typing.Any] = {"nogil": True, "fastmath": True, "error_model": "numpy"}

# Entry points for calls from Python and from C, which take a fifth of the time to compile.
_FROM_KERNELS_ONLY: dict[str, typing.Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_FROM_PYTHON: dict[str, typing.Any] = {"no_cfunc_wrapper": True}

compiled = njit(**_FROM_KERNELS_ONLY, **_SETTINGS)
"""Decorator for a function that only kernels call."""
inlined = njit(forceinline=True, **_FROM_KERNELS_ONLY, **_SETTINGS)
"""Decorator for a small function to inline into kernels. The function must take arrays, not tuples of arrays,
because Numba would otherwise count references to each array at every pixel."""


class Kernel:
    """A kernel: decorator for a function that Python calls, which is compiled at its first call.

    Code that any process of this user has compiled for this machine is loaded instead.
    """

    def __init__(self, function: Callable[..., None]) -> None:
        functools.update_wrapper(self, function)
        self._name = f"{function.__module__}.{function.__qualname__}"
        self._code: typing.Any = _with_cache(function)

    def __call__(self, *arguments: typing.Any) -> None:
        """Run the kernel."""
        if not self._code.signatures:
            with compile_once(self._name):
                self._code.compile(tuple(map(typeof, arguments)))
        self._code(*arguments)

    @property
    def loads(self) -> int:
        """How often code was loaded from the cache rather than compiled."""
        return sum(self._code.stats.cache_hits.values())


kernel = Kernel


def _with_cache(function: Callable[..., None]) -> object:
    """Return the function for Numba to compile, with a cache if its folder can be written to."""
    settings: typing.Any = config
    chosen_by_user = settings.CACHE_DIR
    # Numba reads this setting when it decorates a function. Restore it for functions of other packages.
    try:
        settings.CACHE_DIR = str(kernels_folder())
        return njit(cache=True, **_FROM_PYTHON, **_SETTINGS)(function)
    except RuntimeError:
        # There is no writable cache folder: compile in every process instead.
        return njit(**_FROM_PYTHON, **_SETTINGS)(function)
    finally:
        settings.CACHE_DIR = chosen_by_user
