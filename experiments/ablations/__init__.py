"""Ablations of WeaveNet."""
