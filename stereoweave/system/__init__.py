"""The machine: threads, processes, compiled kernels, Ray."""
