"""Replacement for OpenCV's stereo matchers."""
