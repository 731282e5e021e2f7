"""Spatial video (MV-HEVC), which holds each view in a layer of its own; what it says about its cameras."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from math import radians, tan
from typing import TYPE_CHECKING, Any

import numpy as np

from stereoweave.errors import Note
from stereoweave.stereo import StereoCamera
from stereoweave.video.mp4_marks import MOST_BASELINE_M

if TYPE_CHECKING:
    import av

# FFmpeg's AV_FRAME_DATA_* that PyAV cannot name: it raises an error if a frame has one of them. VIEW_ID marks
# the frames of a video with several layers.
_VIEW_ID = 29
_UNNAMED = 28, _VIEW_ID, 30, 31
# AVStereo3D: nine numbers of 4 bytes, to which later versions of FFmpeg may add.
_STEREO3D_BYTES = 36
# AVStereo3DView and AVSphericalProjection.
RIGHT, _UNSPECIFIED_VIEWS = 2, (0, 3)
RECTILINEAR_MAPPING = 4
# Wider pictures are no perspective views; no lens is so narrow.
_NARROWEST_DEG, _WIDEST_DEG = 1.0, 150.0


@dataclass(frozen=True)
class Stereo3D:
    """What a frame says about its views and cameras, from the container or the stream (AVStereo3D).

    Attributes:
        kind: Frame packing, FFmpeg's AVStereo3DType.
        is_inverted: Whether the right view comes first.
        view: Which view the frame is, FFmpeg's AVStereo3DView.
        baseline_m: Distance of the cameras; 0 if unknown, or not to be believed.
        adjustment_percent: Shift of the views against each other that players apply, in percent of the width.
        field_of_view_deg: Horizontal field of view; 0 if unknown.
    """

    kind: int = 0
    is_inverted: bool = False
    view: int = 0
    baseline_m: float = 0.0
    adjustment_percent: float = 0.0
    field_of_view_deg: float = 0.0

    @property
    def is_right_first(self) -> bool:
        """Whether the base view of a spatial video is the right one. If the file does not say, it is not."""
        return self.view == RIGHT or (self.view in _UNSPECIFIED_VIEWS and self.is_inverted)

    def camera(self, size_px: tuple[int, int]) -> StereoCamera | None:
        """Return the camera of views of this width and height; None unless all of it is known."""
        if not (_NARROWEST_DEG < self.field_of_view_deg < _WIDEST_DEG and self.baseline_m > 0):
            return None
        width_px, height_px = size_px
        return StereoCamera(
            focal_px=width_px / (2 * tan(radians(self.field_of_view_deg) / 2)),
            baseline_m=self.baseline_m,
            cx_px=(width_px - 1) / 2,
            cy_px=(height_px - 1) / 2,
        )

    def note(self) -> Note:
        """Return a note that a spatial video was read, with what it says about its cameras."""
        facts = []
        if self.field_of_view_deg:
            facts.append(f"field of view {self.field_of_view_deg:g} degrees")
        if self.baseline_m:
            facts.append(f"baseline {1000 * self.baseline_m:g} mm")
        if self.adjustment_percent:
            facts.append(f"disparity adjustment {self.adjustment_percent:g} % of the width, not applied")
        what = f"spatial video (MV-HEVC), {'right' if self.is_right_first else 'left'} view first"
        return Note(f"{what}: {', '.join(facts)}" if facts else what)


@dataclass(frozen=True)
class ViewPair:
    """Both views of one moment of a spatial video; placed in time like the frame of the base view."""

    base: "av.VideoFrame"
    other: "av.VideoFrame"

    @property
    def pts(self) -> int | None:
        """Timestamp in units of the stream's time base."""
        return self.base.pts

    @property
    def key_frame(self) -> bool:
        """Whether the pair can be decoded without any earlier frame."""
        return bool(self.base.key_frame)

    @property
    def opaque(self) -> Any:
        """Rank of the packet that holds both views."""
        return _rank(self.base)


def pair_views(frames: Iterable["av.VideoFrame"]) -> Iterator[ViewPair]:
    """Yield the two views of each packet of a spatial video. A view without its other one is dropped.

    The decoder returns the base view first.
    """
    waiting = None
    for frame in frames:
        if waiting is not None and _rank(waiting) == _rank(frame):
            yield ViewPair(waiting, frame)
            waiting = None
        else:
            waiting = frame


def is_spatial(frame: "av.VideoFrame") -> bool:
    """Return whether a decoded frame is one view of several in a layered video."""
    return bool(_filtered(frame, f"mode=select:type={_VIEW_ID}"))


def read_stereo3d(frame: "av.VideoFrame") -> Stereo3D | None:
    """Return what a frame says about its views and cameras; None if it says nothing.

    Where stream and container both say something, the stream decides how views are packed. It knows of no
    cameras.
    """
    from av.sidedata.sidedata import Type

    side_data = read_side_data(frame)
    said = parse_stereo3d(side_data.get(Type.STEREO3D, b""))
    if said is None:
        return None
    if _is_panorama(side_data.get(Type.SPHERICAL)):
        return replace(said, baseline_m=0.0, adjustment_percent=0.0, field_of_view_deg=0.0)
    if said.baseline_m or said.field_of_view_deg or len(side_data) == 1:
        return said
    # The container's word comes first, and hides behind the stream's.
    every = [side_data[index] for index in range(len(side_data))]
    first = parse_stereo3d(next((data for data in every if data.type == Type.STEREO3D), b"")) or said
    return replace(first, kind=said.kind, is_inverted=said.is_inverted, view=said.view)


def parse_stereo3d(data: Any) -> Stereo3D | None:
    """Return what FFmpeg's AVStereo3D says; None if it is cut off."""
    numbers = bytes(data)
    if len(numbers) < _STEREO3D_BYTES:
        return None
    kind, flags, view, _, baseline_um, shift, shift_unit, angle, angle_unit = np.frombuffer(
        numbers[:_STEREO3D_BYTES], np.int32
    ).tolist()
    return Stereo3D(
        kind,
        bool(flags & 1),
        view,
        baseline_m=baseline_um / 1e6 if 0 < baseline_um <= 1e6 * MOST_BASELINE_M else 0.0,
        adjustment_percent=100 * shift / shift_unit if shift_unit else 0.0,
        field_of_view_deg=angle / angle_unit if angle_unit else 0.0,
    )


def read_side_data(frame: "av.VideoFrame") -> Any:
    """Return a frame's side data by type; {} if one of them has no name in PyAV and FFmpeg's filter."""
    # The type stubs of PyAV lack some kinds of side data.
    with suppress(ValueError):
        return frame.side_data
    # A kind of side data that PyAV does not know.
    for named in _filtered(frame, *(f"mode=delete:type={kind}" for kind in _UNNAMED)):
        with suppress(ValueError):
            return named.side_data
    return {}


def _is_panorama(spherical: Any) -> bool:
    return spherical is not None and bool(
        np.frombuffer(bytes(spherical), np.int32, 1)[0] != RECTILINEAR_MAPPING
    )


def _filtered(frame: "av.VideoFrame", *steps: str) -> list["av.VideoFrame"]:
    """Return the frame after FFmpeg's filter `sidedata` with these options.

    [] if it is dropped, or of a format that filters refuse.
    """
    import av

    # FFmpegError includes the errors of an empty sink: BlockingIOError and EOFError.
    with suppress(av.error.FFmpegError):
        graph = av.filter.Graph()
        last = graph.add_buffer(
            width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base
        )
        for step in steps:
            following = graph.add("sidedata", step)
            last.link_to(following)
            last = following
        last.link_to(graph.add("buffersink"))
        graph.configure()
        graph.push(frame)
        return [graph.vpull()]
    return []


def _rank(frame: Any) -> Any:
    return frame.opaque
