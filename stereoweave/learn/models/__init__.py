"""The networks, by the name that a recipe gives."""

from collections.abc import Callable

from stereoweave.learn.models.weave import WeaveNet

MODELS: dict[str, Callable[[], WeaveNet]] = {"weave": WeaveNet}
