"""HTTP service for depth and views.

A Ray Serve config file refers to the application as `stereoweave.service:application`.
"""

from typing import Any


def __getattr__(name: str) -> Any:
    """Import a public name on first use, because the import requires Ray."""
    if name not in ("Settings", "application"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from stereoweave.service import deployment

    return getattr(deployment, name)
