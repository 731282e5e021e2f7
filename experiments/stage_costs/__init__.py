"""Costs of WeaveNet's stages."""
