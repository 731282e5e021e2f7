"""Studies of the networks: ablations, costs, speed."""
