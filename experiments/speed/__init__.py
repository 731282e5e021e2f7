"""Run times of the paper's network and its rivals."""
