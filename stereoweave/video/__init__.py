"""Reading, conversion and writing of stereo videos."""
