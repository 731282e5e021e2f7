"""Opening and rectification of stereo pictures, and search for pairs in folders."""
