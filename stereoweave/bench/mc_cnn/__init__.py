"""From the vectors of MC-CNN to disparities: the stereo method of its paper."""
