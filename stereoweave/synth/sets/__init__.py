"""Rendering and checking of sets of pairs, and contact sheets of scenes."""
