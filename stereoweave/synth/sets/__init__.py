"""Sets of rendered pairs: made, checked, shown."""
