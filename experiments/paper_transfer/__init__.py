"""Transfer of the paper's network from the propeller to the other scenes."""
