"""From an estimate to a view."""
