"""How the loops over pixels are compiled, by Numba, and where that is kept between processes.

Compiled code is kept in the user's cache folder, never in the package, so that an installation may be
read-only. Where a row is worked on as a whole, it is in float32 and without branches, so that the compiler
makes vector instructions of it: three times as fast.
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

compiled = njit(**_SETTINGS)
"""For a function that kernels call."""
inlined = njit(forceinline=True, **_SETTINGS)
"""For a small one that becomes part of its callers. It takes arrays, not a tuple of them: Numba would count
references to them all at every pixel."""


def kernel(function: Callable[..., None]) -> Callable[..., None]:
    """`function`, compiled when it is first called, or loaded where an earlier process has compiled it."""
    settings: typing.Any = config
    chosen_by_user = settings.CACHE_DIR
    # Numba reads this setting while it decorates; it is put back for the sake of other packages' functions.
    try:
        settings.CACHE_DIR = str(Path(chosen_by_user or cache_folder()) / _sources_digest())
        return njit(cache=True, **_SETTINGS)(function)
    except RuntimeError:
        # No home, or no folder that can be written: better to compile in every process than not to work.
        return njit(**_SETTINGS)(function)
    finally:
        settings.CACHE_DIR = chosen_by_user


def cache_folder() -> Path:
    """Where compiled kernels are kept, unless NUMBA_CACHE_DIR names a folder: the user's place for caches."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or "~/AppData/Local"
    elif sys.platform == "darwin":
        base = "~/Library/Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(base).expanduser() / "stereoweave" / "kernels"


@functools.cache
def _sources_digest() -> str:
    """What the sources of all kernels are, in 12 digits.

    Numba looks at the file of the kernel alone, and would keep what functions of other files were before.
    """
    digest = hashlib.sha256()
    for source in (Path(__file__), *sorted(Path(__file__).parents[1].rglob("*_kernels.py"))):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:12]
