"""The page's messages and legends as HTML, and its words for settings, errors and notes."""

import html
import re
from collections.abc import Sequence
from pathlib import Path

from stereoweave.errors import NameOf, Note, format_error
from stereoweave.video.packings import FRAME_PACKINGS

# The name of a layout, but not within a file's name. The form's fields show it with spaces.
_LAYOUT = re.compile(rf"(?<![\w.-])({'|'.join(FRAME_PACKINGS)})(?![\w.-])")


class Wording:
    """How a form words errors and notes: settings by their labels, files without their folders.

    Args:
        folder: Folder of the uploads and results.
        name_of: Function that returns the form's name for a setting.
    """

    def __init__(self, folder: Path, name_of: NameOf) -> None:
        self._folder, self._name_of = folder, name_of

    def format_error(self, error: Exception) -> str:
        """Format an error as a notice."""
        return format_notice([self._format_line(format_error(error, self._name_of))], problem=True)

    def format_notes(self, notes: Sequence[Note]) -> list[str]:
        """Format each note as one line."""
        return [self._format_line(note.format(self._name_of)) for note in notes]

    def _format_line(self, line: str) -> str:
        line = re.sub(rf"{re.escape(str(self._folder))}/(\w+/)+", "", " ".join(line.splitlines()))
        return _LAYOUT.sub(lambda found: found[0].replace("_", " "), line)


def name_setting(labels: dict[str, str], setting: str) -> str | None:
    """Return a form's name for a setting, from the labels of its fields; None if it has no such field."""
    return f"“{labels[setting]}”" if setting in labels else None


def format_notice(lines: Sequence[str], *, problem: bool = False) -> str:
    """Format lines as HTML paragraphs. A problem is highlighted, and announced at once by screen readers."""
    look, role = ("notice problem", "alert") if problem else ("notice", "status")
    return f'<div class="{look}" role="{role}">{format_paragraphs(lines)}</div>'


def format_progress(share: float, what: str) -> str:
    """Format how far a job is, from 0 to 1, as a bar below a line of text."""
    percent = round(100 * share)
    return (
        f'<div class="working"><p>{html.escape(what)}</p><div role="progressbar" aria-label="Progress" '
        f'aria-valuemin="0" aria-valuemax="100" aria-valuenow="{percent}">'
        f'<span style="width:{percent}%"></span></div></div>'
    )


def format_warnings(lines: Sequence[str]) -> str:
    """Format warnings as a banner; nothing without warnings."""
    if not lines:
        return ""
    heading = "Look at this result with care:"
    return f'<div class="warning" role="alert"><b>{heading}</b>{format_paragraphs(lines)}</div>'


def format_paragraphs(lines: Sequence[str]) -> str:
    """Format each line as an HTML paragraph."""
    return "".join(f"<p>{html.escape(line)}</p>" for line in lines)


def format_legend(colours: str, *labels: str) -> str:
    """Format a strip of colours, a CSS background, with labels below it."""
    spans = "".join(f"<span>{label}</span>" for label in labels)
    return f'<div class="ramp" style="background:{colours}"></div><div class="ends">{spans}</div>'


def format_frame(page: str, title: str, style: str = "") -> str:
    """Format a page as a frame, whose scripts reach nothing outside it."""
    # The sensors, for the phone's tilt and a headset.
    allowed = "accelerometer *; gyroscope *; xr-spatial-tracking *"
    return (
        f'<iframe title="{title}" style="{style}" sandbox="allow-scripts" '
        f'allow="{allowed}" srcdoc="{html.escape(page)}"></iframe>'
    )
