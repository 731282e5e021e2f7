"""Calibration and rectification of stereo cameras, and checks of a pair's alignment."""
