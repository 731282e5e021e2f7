"""Compiler settings for the kernels (loops over pixels, compiled by Numba), and a cache of compiled code.

Compiled code is kept in the user's cache folder, never in the package, because an installation may be
read-only. Kernels that process whole rows use float32 and no branches, so the compiler can vectorise them and
they run three times as fast.
"""

import functools
import hashlib
import os
import sys
import typing
from collections.abc import Callable
from pathlib import Path

from numba import config, njit

_SETTINGS: dict[str, typing.Any] = {"nogil": True, "fastmath": True, "error_model": "numpy"}

# Entry points for calls from Python and from C, which take a fifth of the time to compile.
_FROM_KERNELS_ONLY: dict[str, typing.Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_FROM_PYTHON: dict[str, typing.Any] = {"no_cfunc_wrapper": True}

compiled = njit(**_FROM_KERNELS_ONLY, **_SETTINGS)
"""Decorator for a function that only kernels call."""
inlined = njit(forceinline=True, **_FROM_KERNELS_ONLY, **_SETTINGS)
"""Decorator for a small function to inline into kernels. The function must take arrays, not tuples of arrays,
because Numba would otherwise count references to each array at every pixel."""


def kernel(function: Callable[..., None]) -> Callable[..., None]:
    """Compile `function` at its first call, or load the code that an earlier process compiled."""
    settings: typing.Any = config
    chosen_by_user = settings.CACHE_DIR
    # Numba reads this setting when it decorates a function. Restore it for functions of other packages.
    try:
        settings.CACHE_DIR = str(Path(chosen_by_user or cache_folder()) / _sources_digest())
        return njit(cache=True, **_FROM_PYTHON, **_SETTINGS)(function)
    except RuntimeError:
        # There is no writable cache folder: compile in every process instead.
        return njit(**_FROM_PYTHON, **_SETTINGS)(function)
    finally:
        settings.CACHE_DIR = chosen_by_user


def cache_folder() -> Path:
    """Return the default folder for compiled kernels, in the user's cache folder.

    The environment variable NUMBA_CACHE_DIR overrides this default.
    """
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or "~/AppData/Local"
    elif sys.platform == "darwin":
        base = "~/Library/Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(base).expanduser() / "stereoweave" / "kernels"


@functools.cache
def _sources_digest() -> str:
    """Return the first 12 hexadecimal digits of a hash of all kernel sources.

    Numba checks only a kernel's own file for changes, and would keep stale code for functions in other files.
    """
    digest = hashlib.sha256()
    for source in (Path(__file__), *sorted(Path(__file__).parents[1].rglob("*_kernels.py"))):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:12]
