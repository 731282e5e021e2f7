"""Experiment on the claims of "Fast Depth Estimation for View Synthesis"."""
