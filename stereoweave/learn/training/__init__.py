"""The loop, the objective and its losses."""
