"""Calibration, rectification and their checks."""
