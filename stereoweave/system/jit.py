"""Compiler settings for the kernels (loops over pixels, compiled by Numba).

Compiled code is kept in the user's cache folder (`kernel_cache`), never in the package, because an
installation may be read-only. Kernels that process whole rows use float32 and no branches, so the compiler
can vectorise them and they run three times as fast. Numba is imported only for a kernel that does not ship
(`shipped_kernels`).
"""

import functools
import threading
import typing
from collections.abc import Callable

from stereoweave.system.kernel_cache import compile_once, kernels_folder
from stereoweave.system.shipped_kernels import find_shipped, flatten
from stereoweave.system.threads import beyond_ctrl_c

_SETTINGS: dict[str, typing.Any] = {"nogil": True, "fastmath": True, "error_model": "numpy"}

# Entry points for calls from Python and from C, which take a fifth of the time to compile.
_FROM_KERNELS_ONLY: dict[str, typing.Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_FROM_PYTHON: dict[str, typing.Any] = {"no_cfunc_wrapper": True}

Function = Callable[..., typing.Any]
# Settings of the functions that kernels call, and what Numba has made of them.
_called: dict[Function, dict[str, typing.Any]] = {}
_made: dict[Function, Function] = {}
_lock = threading.RLock()


def compiled(function: Function) -> Function:
    """Mark a function that only kernels call."""
    _called[function] = {}
    return function


def inlined(function: Function) -> Function:
    """Mark a small function to inline into kernels.

    The function must take arrays, not tuples of arrays, because Numba would otherwise count references to
    each array at every pixel.
    """
    _called[function] = {"forceinline": True}
    return function


class Kernel:
    """A kernel: decorator for a function that Python calls, which is loaded or compiled at its first call.

    Code that any process of this user has compiled for this machine is loaded. Otherwise the kernel that
    ships with the package is compiled by LLVM. If there is none for this machine, for these arguments or
    for the present sources, the function is compiled by Numba, which takes longer.

    An array that the kernel writes to must not overlap another of its arrays: the shipped code relies on it.
    """

    def __init__(self, function: Callable[..., None]) -> None:
        functools.update_wrapper(self, function)
        self.name = f"{function.__module__}.{function.__qualname__}"
        self._function = function
        self._shipped = find_shipped(self.name)

    def __call__(self, *arguments: typing.Any) -> None:
        """Run the kernel."""
        if self._shipped:
            kinds, words = flatten(arguments)
            if kinds == self._shipped.kinds:
                self._shipped(words)
                return
        code = self.dispatcher
        if not code.signatures:
            beyond_ctrl_c(lambda: self._compile(arguments))
        code(*arguments)

    def _compile(self, arguments: tuple[typing.Any, ...]) -> None:
        """Let Numba load or compile the function for such arguments."""
        from numba import typeof

        _, _, module = self._function.__module__.rpartition(".")
        with compile_once(self.name, f"*/{module}.{self._function.__qualname__}-*.nbi"):
            self.dispatcher.compile(tuple(map(typeof, arguments)))

    @property
    def dispatcher(self) -> typing.Any:
        """The function for Numba to compile."""
        with _lock:
            if self._function not in _made:
                _made[self._function] = _with_cache(self._function)
                _prepare_called_functions(self._function)
            return _made[self._function]

    @property
    def loads(self) -> int:
        """How often code was loaded from the cache rather than compiled."""
        shipped = self._shipped.loads if self._shipped else 0
        return shipped + sum(self.dispatcher.stats.cache_hits.values())


kernel = Kernel


def _prepare_called_functions(kernel: Function) -> None:
    """Put what Numba makes of the marked functions in the place of these functions, in all their modules."""
    from numba import njit

    for function, settings in _called.items():
        if function not in _made:
            _made[function] = njit(**settings, **_FROM_KERNELS_ONLY, **_SETTINGS)(function)
    for function in (kernel, *_called):
        names = function.__globals__
        names |= {name: _made[value] for name, value in names.items() if _is_marked(value)}


def _is_marked(value: object) -> bool:
    return isinstance(value, typing.Hashable) and value in _called


def _with_cache(function: Callable[..., None]) -> Function:
    """Return the function for Numba to compile, with a cache if its folder can be written to."""
    from numba import config, njit

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
