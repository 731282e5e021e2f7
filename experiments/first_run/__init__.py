"""Benchmark of the run times of the paper's network and its rivals."""
