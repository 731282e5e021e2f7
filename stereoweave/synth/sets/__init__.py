"""Sets of rendered pairs: making, checking, contact sheets."""
