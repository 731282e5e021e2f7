"""Rendering of worlds to images and depth maps."""
