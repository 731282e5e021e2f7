"""What the page converts videos to."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Output:
    """What a video is converted to: its label, how to look at it, and the settings of `VideoJob`."""

    label: str
    viewing: str
    settings: dict[str, Any]


OUTPUTS: dict[str, Output] = {
    "depth": Output("Depth in colour", "Red is near, blue is far.", {"depth": True}),
    "between": Output("View from between the cameras", "An ordinary video.", {"position": 0.5}),
    "side_by_side": Output(
        "Side by side", "For VR headsets: the left eye's view is on the left.", {"layout": "side_by_side"}
    ),
    "side_by_side_half": Output(
        "Side by side, half width",
        "For 3-D televisions, which stretch each half to the full width.",
        {"layout": "side_by_side_half"},
    ),
    "crossed": Output("Crossed", "Cross your eyes until the two pictures become one.", {"layout": "crossed"}),
    "top_bottom": Output(
        "Top and bottom", "For VR headsets: the left eye's view is on top.", {"layout": "top_bottom"}
    ),
    "anaglyph_dubois": Output(
        "Anaglyph", "Look through red-cyan glasses, red on the left eye.", {"layout": "anaglyph_dubois"}
    ),
    "rgbd": Output(
        "Picture and depth", "For programs and displays that read colour with depth.", {"layout": "rgbd"}
    ),
}
