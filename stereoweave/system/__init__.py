"""Use of the machine: threads, processes, compiled kernels and Ray."""
