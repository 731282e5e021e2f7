"""Pytest plugin that limits the memory of the tests and of every process that they start."""

import resource

# A mutated loop may append to a list forever.
_MOST_BYTES = 8 * 2**30


def pytest_configure() -> None:
    """Set the limit before any test is collected."""
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (_MOST_BYTES, hard))
