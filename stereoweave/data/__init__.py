"""Real datasets as pairs with their ground truth."""
