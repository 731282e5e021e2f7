"""Names of all frame packings of a stereo video, which are more than the layouts of a picture."""

from stereoweave.pictures.pair_layouts import PAIR_LAYOUTS

# Whether the right view comes first, by the packing's name.
FRAME_SEQUENTIAL = {"frame_sequential": False, "frame_sequential_right_first": True}
TWO_STREAMS = {"two_streams": False, "two_streams_right_first": True}
# Packings of which no frame holds both views.
APART = frozenset({*FRAME_SEQUENTIAL, *TWO_STREAMS})
FRAME_PACKINGS = (*PAIR_LAYOUTS, *FRAME_SEQUENTIAL, *TWO_STREAMS)


def find_swapped_packing(name: str | None) -> str | None:
    """Return the name of the frame packing with the eyes swapped; None if there is none."""
    for names in (FRAME_SEQUENTIAL, TWO_STREAMS):
        if name in names:
            return next(other for other in names if other != name)
    layout = PAIR_LAYOUTS.get(name or "")
    other = layout.swapped() if layout else None
    return next((known for known, each in PAIR_LAYOUTS.items() if each == other), None)
