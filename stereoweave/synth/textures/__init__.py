"""What draws the textures: each procedure makes one surface from a generator of random numbers."""
