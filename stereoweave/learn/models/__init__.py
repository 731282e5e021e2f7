"""The networks, by the name that a recipe gives."""

from stereoweave.learn.models.weave import WeaveNet

MODELS: dict[str, type[WeaveNet]] = {"weave": WeaveNet}
