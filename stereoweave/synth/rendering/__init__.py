"""Rendering of worlds: images and depth."""
