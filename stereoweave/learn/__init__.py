"""Networks and their training; the only subpackage that needs PyTorch."""
