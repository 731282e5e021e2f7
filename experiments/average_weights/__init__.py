"""Mean of the weights of several runs of one network."""
