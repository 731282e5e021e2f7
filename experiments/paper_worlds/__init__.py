"""Scores of the paper's networks on sets by world: in worlds of their training, and in others."""
