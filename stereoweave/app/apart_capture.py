"""Reading of videos for the live view whose frames do not hold both views, of which OpenCV decodes one."""

from contextlib import suppress
from pathlib import Path

from stereoweave.errors import FormatError, Remedy, StereoweaveError
from stereoweave.pictures.pair_layouts import Picture
from stereoweave.video.packings import APART
from stereoweave.video.reader import open_video
from stereoweave.video.tracks import shows_one_view
from stereoweave.video.twin_streams import open_twins


class ApartCapture:
    """Video file with the views in two layers (spatial video), in two streams or in turn, read pair by pair.

    Args:
        path: The file.
        format: Frame packing, a name in `FRAME_PACKINGS`. Default: as the file says.

    Attributes:
        camera: Camera of the views, if the file declares it.
        notes: Notes on views and colours.
        rate: Pairs per second.
        packing: Name of its frame packing; None for a spatial video.

    Raises:
        FormatError: The file has no pair of both views.
        StereoweaveError: A frame packing is given for a spatial video.
    """

    def __init__(self, path: Path, format: str | None = None) -> None:
        video = open_video([path], format)
        self.camera, self.notes, self.rate = video.camera, video.notes, float(video.rate)
        self.packing = video.frame_packing
        self._frames = video.frames()
        self._pictures: tuple[Picture, Picture] | None = None

    @classmethod
    def open(cls, source: str, format: str | None = None) -> "ApartCapture | None":
        """Return the reader of such a video; None for any other source.

        Raises:
            FormatError: `format` names two streams or views in turn, but the source is no file.
        """
        path = Path(source)
        if not path.is_file():
            if format in APART:
                raise FormatError(
                    f"{source}: expected a video file for the frame packing {format}, found another source",
                    remedy=Remedy("convert it to side_by_side first", ("video",)),
                )
            return None
        return cls(path, format) if format in APART or _is_apart(path, format) else None

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


def _is_apart(path: Path, format: str | None) -> bool:
    """Return whether a file says itself that its views are apart; False for one that cannot be decoded."""
    if shows_one_view(path, spatial_only=format is not None):
        return True
    with suppress(StereoweaveError):
        return format is None and open_twins(path, None) is not None
    return False
