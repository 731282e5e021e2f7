"""A converted frame, as a conversion shows it to whoever watches (`VideoJob.on_converted`)."""

from typing import NamedTuple

from stereoweave.stereo import Estimate, StereoPair
from stereoweave.video.reader import StereoFrame
from stereoweave.video.survey import Survey
from stereoweave.video.writer import Picture


class ConvertedFrame(NamedTuple):
    """Converted frame of a video.

    Attributes:
        frame: The frame as read.
        pair: Its aligned pair; of half width or height if the layout is.
        estimate: The pair's estimate.
        picture: The output image.
        survey: Disparities of the whole video, in pixels of the pair.
    """

    frame: StereoFrame
    pair: StereoPair
    estimate: Estimate
    picture: Picture
    survey: Survey
