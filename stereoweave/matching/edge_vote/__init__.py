"""Vote of the neighbourhood on disparities at depth edges."""
