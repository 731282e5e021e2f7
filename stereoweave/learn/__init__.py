"""Networks and their training; the only package that needs PyTorch."""
