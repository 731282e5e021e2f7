"""What a training sees: painted and rendered pairs, batches."""
