"""Reading of a spatial video for the live view, because OpenCV decodes only one of its views."""

from pathlib import Path

from stereoweave.pictures.pair_layouts import Picture
from stereoweave.video.reader import open_video
from stereoweave.video.tracks import is_spatial_file


class SpatialCapture:
    """Spatial video that is read frame by frame.

    Attributes:
        camera: Camera of the views, if the file declares it.
        notes: Notes on views and colours.
        rate: Frames per second.

    Raises:
        FormatError: The file has no frame with both views.
    """

    def __init__(self, path: Path) -> None:
        video = open_video([path])
        self.camera, self.notes, self.rate = video.camera, video.notes, float(video.rate)
        self._frames = video.frames()
        self._pictures: tuple[Picture, Picture] | None = None

    @classmethod
    def open(cls, source: str) -> "SpatialCapture | None":
        """Return the reader of a spatial video; None for any other source."""
        path = Path(source)
        return cls(path) if path.is_file() and is_spatial_file(path) else None

    def grab(self) -> bool:
        """Read the next frame; return False at the end."""
        frame = next(self._frames, None)
        self._pictures = (frame.left, frame.right) if frame else None
        return frame is not None

    def retrieve(self) -> tuple[Picture, ...]:
        """Return the left and the right view of the frame that was read last."""
        return self._pictures or ()

    def release(self) -> None:
        """Close the file."""
        self._frames = iter(())
