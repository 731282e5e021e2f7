"""What a command has printed."""


def without_steps(told: str) -> list[str]:
    """Return the lines of stderr, but for those that name a step, which only a slow machine has."""
    return [line for line in told.splitlines() if not line.endswith(" …")]
