"""Procedural textures, each drawn from a random generator."""
