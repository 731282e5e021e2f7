"""Checks of arguments of the Python interface; each raises a one-line StereoweaveError.

Checks of numbers return Python's own float or int, which the caller keeps.

NumPy is imported only inside the functions, because the command line's help imports this module and must be
fast.
"""

import reprlib
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from numbers import Integral, Real
from typing import TYPE_CHECKING, TypeGuard, cast

from stereoweave.errors import Remedy, StereoweaveError

if TYPE_CHECKING:
    import numpy as np

_MOST_SHOWN = 60
_MOST_MEANT = 3
_LEAST_LIKENESS = 0.7  # "gpu" is no slip for "cpu"
_DTYPES = {"f": "floats", "u": "uint8", "b": "booleans"}


def check_number(name: str, value: object) -> float:
    """Return a real number as a float; NaN and infinity are allowed.

    A NumPy scalar would make Numba compile every kernel again, and a ratio cannot be formatted.
    """
    if not isinstance(value, Real) or isinstance(value, bool) or not _is_held_by_float(value):
        raise StereoweaveError(f"{name}: expected a number, got {describe(value)}")
    return float(value)


def check_whole_number(name: str, value: object) -> int:
    """Return an integer within the range of a float as an int."""
    if not isinstance(value, Integral) or isinstance(value, bool) or not _is_held_by_float(value):
        raise StereoweaveError(f"{name}: expected a whole number, got {describe(value)}")
    return int(value)


def as_two_numbers(
    setting: str, value: object, expected: str, remedy: Remedy | None = None
) -> tuple[float, float]:
    """Return a sequence or an array of two numbers as floats.

    Raises:
        StereoweaveError: It is something else; the message says what `setting` is expected to be.
    """
    is_row = isinstance(value, Sequence) or (is_plain_array(value) and value.ndim == 1)
    numbers = tuple(cast("Sequence[float]", value)) if is_row else ()
    if len(numbers) != 2:
        raise StereoweaveError(f"expected {expected}, got {describe(value)}", setting=setting, remedy=remedy)
    return check_number(setting, numbers[0]), check_number(setting, numbers[1])


def check_choice(
    setting: str, value: object, choices: Iterable[str], kind: type[StereoweaveError] = StereoweaveError
) -> None:
    """Require one of the names in `choices`; the error, of class `kind`, suggests what was probably meant."""
    names = list(choices)
    if not isinstance(value, str) or value not in names:
        message = f"expected one of {', '.join(names)}, found {describe(value)}"
        hint = suggest(value, names) if isinstance(value, str) else ""
        raise kind(message + hint, setting=setting)


def suggest(value: str, names: Sequence[str]) -> str:
    """Return "; did you mean ...?" with names that begin with a value, resemble it or have its initials."""
    typed = value.lower().replace("-", "_").replace(" ", "_")
    longer = [typed] if typed in names else [name for name in names if typed and name.startswith(typed)]
    by_initials = [name for name in names if "".join(part[:1] for part in name.split("_")) == typed]
    meant = longer or get_close_matches(typed, names, 1, _LEAST_LIKENESS) or by_initials
    return f"; did you mean {' or '.join(meant[:_MOST_MEANT])}?" if meant else ""


def check_flag(name: str, value: object) -> None:
    """Require True or False."""
    import numpy as np

    if not isinstance(value, bool | np.bool_):
        raise StereoweaveError(f"{name}: expected True or False, got {describe(value)}")


def check_kind(name: str, value: object, *kinds: type) -> None:
    """Require an instance of one of `kinds`."""
    if not isinstance(value, kinds):
        expected = " or ".join(kind.__name__ for kind in kinds)
        raise StereoweaveError(f"{name}: expected {expected}, got {describe(value)}")


def check_array(name: str, value: object, kind: str, dimensions: int) -> None:
    """Require a plain array with `dimensions` axes and a dtype of the given kind: "f", "u" or "b"."""
    if not is_plain_array(value) or value.dtype.kind != kind or value.ndim != dimensions:
        raise StereoweaveError(
            f"{name}: expected an array of {_DTYPES[kind]} with {dimensions} axes, got {describe(value)}"
        )


def check_numbers(name: str, value: object) -> None:
    """Require a real number or an array of real numbers."""
    import numpy as np

    if not isinstance(value, Real | np.ndarray) or np.asarray(value).dtype.kind not in "fiu":
        raise StereoweaveError(f"{name}: expected an array of numbers, got {describe(value)}")


def is_plain_array(value: object) -> TypeGuard["np.ndarray"]:
    """Return whether a value is an ndarray, but not a matrix or masked array, whose arithmetic differs."""
    import numpy as np

    return isinstance(value, np.ndarray) and not isinstance(value, np.matrix | np.ma.MaskedArray)


def _is_held_by_float(value: Real) -> bool:
    try:
        float(value)
    except OverflowError:
        return False
    return True


def describe(value: object) -> str:
    """Describe a value briefly for an error message; describe an array by its type, dtype and shape."""
    import numpy as np

    if isinstance(value, np.ndarray):
        return f"{type(value).__name__} of {value.dtype} {list(value.shape)}"
    text = " ".join(reprlib.repr(value).split())
    return text if len(text) <= _MOST_SHOWN else type(value).__name__
