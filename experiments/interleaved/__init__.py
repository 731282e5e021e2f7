"""How many interleaved pictures are suspected, and how many ordinary ones."""
