"""Training data: collages, rendered pairs, datasets, batches."""
