"""Sets of rendered pairs: making and checking them, and contact sheets."""
