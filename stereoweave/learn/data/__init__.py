"""Training data: collages, rendered pairs, datasets, and the batches made from them."""
