"""Training loops, objectives and losses."""
