"""Networks and their training; the only part that needs PyTorch."""
