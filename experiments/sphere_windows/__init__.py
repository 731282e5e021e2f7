"""Distances of a whole VR180 pair, matched in one image of all directions or in nine perspective windows."""
