"""Many pairs: on this machine, or on a cluster with Ray."""
