"""Type checker for jaxtyping's import hook, whose pytest option accepts a call for only one package."""

from collections.abc import Callable
from functools import wraps
from typing import Any

from beartype import BeartypeConf, beartype

_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True))


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that beartype checks.

    It is decorated at its first call: that takes 1 ms, and each process of the tests imports thousands of
    functions of which it calls a part.
    """
    checked: list[Callable[..., Any]] = []

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        if not checked:
            checked.append(_beartype(function))
        return checked[0](*args, **kwargs)

    return call
