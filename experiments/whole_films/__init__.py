"""Whole conversions of films: exactness of frames, times and sound, memory and speed."""
