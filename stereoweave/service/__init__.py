"""The HTTP service.

`stereoweave.service:application` is what a Serve config file names.
"""

from typing import Any


def __getattr__(name: str) -> Any:
    """The public names, imported when they are first asked for: they need Ray."""
    if name not in ("Settings", "application"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from stereoweave.service import deployment

    return getattr(deployment, name)
