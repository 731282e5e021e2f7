"""Benchmark of the speed of `stereoweave video`."""
