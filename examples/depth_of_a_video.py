"""Depth of each frame of a side-by-side video or camera, in a loop of your own: writes depth.mp4.

Run: python examples/depth_of_a_video.py FILM.mp4 (or a camera's number; Ctrl-C ends it). To watch depth
live, use `stereoweave live FILM.mp4`; for videos with a temporal filter and sound, `stereoweave video`.
"""

import sys

import cv2
import numpy as np

import stereoweave as sw
from stereoweave.io.colormap import colour_disparity

if len(sys.argv) != 2:
    sys.exit("usage: python depth_of_a_video.py FILM.mp4 (or a camera's number)")
source = sys.argv[1]
capture = cv2.VideoCapture(int(source) if source.isdigit() else source)
matcher = sw.Matcher("small")  # loaded once
film, frames = None, 0
try:
    while (frame := capture.read()[1]) is not None:
        rgb = cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)  # OpenCV uses BGR, Stereoweave RGB
        left, right = (np.ascontiguousarray(half) for half in np.split(rgb, 2, axis=1))
        colours = colour_disparity(matcher.estimate(left, right).disparity_px, (0, 40))
        if film is None:
            size_px = colours.shape[1], colours.shape[0]
            film = cv2.VideoWriter("depth.mp4", cv2.VideoWriter.fourcc(*"mp4v"), 25, size_px)
        film.write(cv2.cvtColor(colours, cv2.COLOR_RGB2BGR))
        frames += 1
except KeyboardInterrupt:
    pass
if film is not None:
    film.release()
print(f"{frames} frames")
