"""Formats of cameras and discs that cannot be read: their names, and the ways to convert them."""

from pathlib import Path

from stereoweave.errors import FormatError

_BACK_TO_BACK = (
    "of two lenses that look in opposite directions, which is no stereo pair",
    "if the camera took it in 3-D, export it as VR180 or side by side with the maker's program",
)
_VENDOR_RAW = "render it as an ordinary video with the maker's program or DaVinci Resolve"
_DISC = "convert it to a side-by-side video, as BD3D2MK3D does"
# What a file is and what to do, by its ending. Their contents are those of other formats, such as JPEG and
# MP4, or nobody outside has described them.
_KINDS = {
    ".insp": (f"an Insta360 picture {_BACK_TO_BACK[0]}", _BACK_TO_BACK[1]),
    ".insv": (f"an Insta360 video {_BACK_TO_BACK[0]}", _BACK_TO_BACK[1]),
    ".360": (f"a GoPro video {_BACK_TO_BACK[0]}", "export an ordinary video from it with GoPro Player"),
    ".lfp": ("a Lytro light field", "save two of its views as pictures, as Lytro Desktop does"),
    ".lfr": ("a Lytro light field", "save two of its views as pictures, as Lytro Desktop does"),
    ".lytro": ("a Lytro light field", "save two of its views as pictures, as Lytro Desktop does"),
    ".ssif": ("a film of a 3-D Blu-ray, whose views MVC encodes together", _DISC),
    ".iso": ("an image of a disc", f"copy the film from it, as MakeMKV does; {_DISC}"),
    ".aivu": ("Apple Immersive Video", "export it as VR180 or side by side"),
    ".braw": ("Blackmagic RAW", _VENDOR_RAW),
    ".r3d": ("REDCODE RAW", _VENDOR_RAW),
}


def check_readable(path: Path, expected: str) -> None:
    """Raise a FormatError if a file's ending is that of a format which cannot be read."""
    kind = _KINDS.get(path.suffix.lower())
    if kind:
        found, advice = kind
        raise FormatError(f"{path}: expected {expected}, found {found}; {advice}")
