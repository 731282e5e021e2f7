"""Times within a video, as text, and the length of its parts."""

from fractions import Fraction

PART_S = 4
"""Length of a part of a conversion, which begins with a key frame; an interrupted run loses only the last."""


def format_time(time_s: float | Fraction, *, decimals: int = 1, hours: bool = False) -> str:
    """Return a time as minutes and seconds, for example 1:02.3 for 62.345 s; 0:01:02.3 with hours."""
    parts = 10**decimals
    minutes, rest = divmod(round(time_s * parts), 60 * parts)
    whole = f"{minutes // 60}:{minutes % 60:02}" if hours else f"{minutes}"
    seconds = f"{whole}:{rest // parts:02}"
    return f"{seconds}.{rest % parts:0{decimals}}" if decimals else seconds


def format_frame_time(time_s: float | Fraction) -> str:
    """Return the time of one frame, which milliseconds tell from others: 0:01:02.345 for 62.345 s."""
    return format_time(time_s, decimals=3, hours=True)
