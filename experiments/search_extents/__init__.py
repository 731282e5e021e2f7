"""Errors of a network whose estimates are matched once more to several extents."""
