"""The timeline of a checked video: a picture of its depth, and of the differences of the eyes, over time."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from stereoweave.rendering.comfort import SCREENS
from stereoweave.video.frame_check import FrameCheck
from stereoweave.video.times import format_time
from stereoweave.video.video_check import ShotCheck, VideoCheck

Place = tuple[float, float]
Colour = tuple[int, int, int]

WIDTH_PX, HEIGHT_PX = 1600, 940
# Drawn at twice the size and scaled down, because Pillow's lines have steps.
_FINER = 2
_LEFT_PX, _RIGHT_PX = 120, 1570
_PICTURES_PX, _STRIP_PX = (64, 144), (152, 180)
_USUAL_SCREEN = "television"
# The band is cut off at these parallaxes; more is a mistake of the matcher or of the video.
_MOST_PERCENT = 30.0
_LETTER_PX, _SMALL_PX = 17, 14
_LEAST_STEP_PX = 28

_MINUTES = (0.25, 0.5, 1, 2, 5, 10, 15, 30)

_BLACK, _GREY, _FAINT, _WHITE = (30, 30, 30), (110, 110, 110), (225, 225, 225), (255, 255, 255)
_BAND, _EDGE, _GOOD, _ZONE = (160, 190, 225), (45, 95, 160), (90, 160, 90), (222, 240, 218)
_BAD, _SECOND = (200, 45, 45), (225, 130, 20)

# Names of defects that fit into the strip.
_SHORT = {
    "too_plain": "plain",
    "unrelated": "other scene",
    "stacked": "eyes stacked",
    "same_picture": "flat",
    "vertical_shift": "rows",
    "not_rectified": "rows",
    "empty_left": "left empty",
    "empty_right": "right empty",
    "too_deep": "too deep",
    "cut_off": "cut off",
}


def shorten(defects: Sequence[str]) -> str:
    """Return names of defects in few letters, for tables and pictures."""
    return ", ".join(dict.fromkeys(_SHORT.get(name, name) for name in defects))


def draw_timeline(check: VideoCheck, name: str, screen: str | None) -> UInt8[np.ndarray, "h w 3"]:
    """Return the timeline of a checked video as uint8 RGB.

    Args:
        check: The checked video.
        name: Title of the picture.
        screen: Screen whose budget is shown; default: a television's.
    """
    end_s = max(float(check.shots[-1].end_s), 1e-3)
    sheet = _Sheet(end_s)
    shots = "1 shot" if len(check.shots) == 1 else f"{len(check.shots)} shots"
    title = f"{name}: {_shorten_time(end_s)}, {shots}, {check.shots[0].width_px} px wide"
    sheet.text((_LEFT_PX, 14), title, size=20)
    _draw_shots(sheet, check.shots)
    _draw_depth(sheet, check.shots, screen or _USUAL_SCREEN)
    rows = _Line("rows_px", _EDGE, "median vertical error")
    panel = _make_panel(sheet, check.shots, (620, 720), "rows of the eyes apart, px", [rows])
    _draw_lines(sheet, panel, check.shots, [rows])
    light = [_Line("exposure_stops", _EDGE, "exposure"), _Line("colour_stops", _SECOND, "colour")]
    panel = _make_panel(
        sheet, check.shots, (770, 870), "right eye against the left one, stops: up is brighter", light
    )
    _draw_lines(sheet, panel, check.shots, light)
    _draw_time_axis(sheet, 870)
    return sheet.finish()


@dataclass(frozen=True)
class _Line:
    """A number of `FrameCheck` to draw over time, with its colour and its label."""

    name: str
    colour: Colour
    label: str


@dataclass(frozen=True)
class _Panel:
    """A part of the picture, from `top` to `bottom`, with the values at both ends of its vertical axis."""

    top: int
    bottom: int
    at_top: float
    at_bottom: float

    def y(self, value: float) -> float:
        """Return the row of a value; values beyond the ends are at the ends."""
        share = (value - self.at_top) / (self.at_bottom - self.at_top)
        return self.top + min(max(share, 0.0), 1.0) * (self.bottom - self.top)


class _Sheet:
    """A picture to draw on in its final pixels, with time along its columns."""

    def __init__(self, end_s: float) -> None:
        self.end_s = end_s
        self.image = Image.new("RGB", (_FINER * WIDTH_PX, _FINER * HEIGHT_PX), _WHITE)
        self._pen = ImageDraw.Draw(self.image)

    def x(self, time_s: float) -> float:
        """Return the column of a time."""
        return _LEFT_PX + min(max(time_s / self.end_s, 0.0), 1.0) * (_RIGHT_PX - _LEFT_PX)

    def line(self, points: Sequence[Place], colour: Colour, width: float = 1) -> None:
        """Draw a line through points."""
        self._pen.line([_fine(point) for point in points], colour, max(1, round(_FINER * width)), "curve")

    def area(self, points: Sequence[Place], colour: Colour) -> None:
        """Fill a polygon."""
        self._pen.polygon([_fine(point) for point in points], colour)

    def box(self, start: Place, end: Place, colour: Colour) -> None:
        """Fill a rectangle."""
        self._pen.rectangle([_fine(start), _fine(end)], colour)

    def text(
        self,
        place: Place,
        words: str,
        *,
        size: int = _LETTER_PX,
        colour: Colour = _BLACK,
        anchor: str = "la",
    ) -> None:
        """Write words; `anchor` is Pillow's: which point of the words is at the place."""
        # Pillow's own font lacks many letters, and writes boxes for them.
        font = ImageFont.load_default(_FINER * size)
        self._pen.text(_fine(place), words, colour, font, anchor)

    def measure(self, words: str, size: int = _SMALL_PX) -> float:
        """Return the width of words."""
        return self._pen.textlength(words, ImageFont.load_default(_FINER * size)) / _FINER

    def paste(self, picture: UInt8[np.ndarray, "h w 3"], place: Place, height: int) -> None:
        """Paste a picture, scaled to a height."""
        size = max(1, round(_FINER * height * picture.shape[1] / picture.shape[0])), _FINER * height
        scaled = Image.fromarray(picture).resize(size, Image.Resampling.LANCZOS)
        self.image.paste(scaled, (round(_FINER * place[0]), round(_FINER * place[1])))

    def finish(self) -> UInt8[np.ndarray, "h w 3"]:
        """Return the picture."""
        return np.asarray(self.image.resize((WIDTH_PX, HEIGHT_PX), Image.Resampling.BOX)).copy()


def _fine(place: Place) -> Place:
    return _FINER * place[0], _FINER * place[1]


def _draw_shots(sheet: _Sheet, shots: Sequence[ShotCheck]) -> None:
    """Draw a thumbnail of each shot that is wide enough, and a strip that names defects."""
    sheet.text((_LEFT_PX - 12, sum(_STRIP_PX) / 2), "shot", anchor="rm", colour=_GREY)
    for number, shot in enumerate(shots, 1):
        start, end = sheet.x(float(shot.start_s)), sheet.x(float(shot.end_s))
        height = _PICTURES_PX[1] - _PICTURES_PX[0]
        width = height * shot.thumbnail.shape[1] / shot.thumbnail.shape[0]
        if end - start >= width + 4:
            sheet.paste(shot.thumbnail, (start + 2, _PICTURES_PX[0]), height)
        # A pixel of white parts the shots, if they are not too many.
        gap = 1 if end - start > 4 else 0
        colour = _BAD if shot.defects else _GOOD
        sheet.box((start + gap, _STRIP_PX[0]), (max(end - gap, start + 1), _STRIP_PX[1]), colour)
        words = f"{number}  {shorten(shot.defects)}".strip()
        fitting = next((word for word in (words, str(number)) if sheet.measure(word) < end - start - 8), None)
        if fitting:
            middle = (start + end) / 2, sum(_STRIP_PX) / 2
            sheet.text(middle, fitting, size=_SMALL_PX, colour=_WHITE, anchor="mm")


def _draw_depth(sheet: _Sheet, shots: Sequence[ShotCheck], screen: str) -> None:
    """Draw the band of depth, with the budget of a screen, and what the borders cut off."""
    budget = SCREENS[screen]
    values = [value for shot in shots for value in shot.range_percent if not math.isnan(value)]
    least = max(min([*values, -budget.front_percent - 1]), -_MOST_PERCENT)
    most = min(max([*values, budget.behind_percent + 1]), _MOST_PERCENT)
    margin = 0.06 * (most - least)
    panel = _Panel(222, 540, least - margin, most + margin)
    zone = panel.y(-budget.front_percent), panel.y(budget.behind_percent)
    sheet.box((_LEFT_PX, zone[0]), (_RIGHT_PX, zone[1]), _ZONE)
    _draw_axis(sheet, panel, "depth as shown, % of the width: up is nearer", "{:+g} %")
    for shot in shots:
        _draw_band(sheet, panel, shot)
    sheet.line([(_LEFT_PX, panel.y(0.0)), (_RIGHT_PX, panel.y(0.0))], _BLACK, 2)
    sheet.text((_RIGHT_PX - 6, panel.y(0.0) - 3), "screen", size=_SMALL_PX, anchor="rd")
    words = f"{screen}: -{budget.front_percent:g} % to +{budget.behind_percent:g} % is comfortable"
    sheet.text((_RIGHT_PX - 6, zone[1] - 3), words, size=_SMALL_PX, colour=(60, 120, 60), anchor="rd")
    _draw_cuts(sheet, shots, (222, 870))
    for side, (name, y) in enumerate((("left", 552), ("right", 570))):
        sheet.text((_LEFT_PX - 12, y + 6), f"cut off {name}", size=_SMALL_PX, colour=_GREY, anchor="rm")
        sheet.box((_LEFT_PX, y), (_RIGHT_PX, y + 12), _FAINT)
        for start, end, sample in chain.from_iterable(map(_find_spans, shots)):
            if sample.windows_px[side] > 0:
                sheet.box((sheet.x(start), y), (max(sheet.x(end), sheet.x(start) + 2), y + 12), _BAD)


def _draw_band(sheet: _Sheet, panel: _Panel, shot: ShotCheck) -> None:
    """Draw a shot's depth from sample to sample; to the ends of the shot, it stays as at the last sample."""
    known = [sample for sample in shot.samples if sample.depth]
    if not known:
        return
    times = [float(shot.start_s), *(float(one.time) for one in known), float(shot.end_s)]
    known = [known[0], *known, known[-1]]
    edges = []
    for index in (0, 1):  # the nearest and the farthest points
        percents = [-100 * one.depth[index] / shot.width_px for one in known if one.depth]
        edges.append([(sheet.x(t), panel.y(value)) for t, value in zip(times, percents, strict=True)])
    sheet.area([*edges[0], *edges[1][::-1]], _BAND)
    for edge in edges:
        sheet.line(edge, _EDGE, 2)


def _find_spans(shot: ShotCheck) -> Iterator[tuple[float, float, FrameCheck]]:
    """Yield start and end of the part of a shot for which each of its samples stands, and the sample."""
    times = [float(sample.time) for sample in shot.samples]
    middles = [(before + after) / 2 for before, after in zip(times[:-1], times[1:], strict=True)]
    starts, ends = [float(shot.start_s), *middles], [*middles, float(shot.end_s)]
    yield from zip(starts, ends, shot.samples, strict=True)


def _make_panel(
    sheet: _Sheet, shots: Sequence[ShotCheck], rows: tuple[int, int], title: str, lines: Sequence[_Line]
) -> _Panel:
    """Draw the axis of a panel that holds all values of its lines, and 0."""
    values = [getattr(sample, line.name) for line in lines for shot in shots for sample in shot.samples]
    known = [value for value in values if not math.isnan(value)]
    low, high = min([0.0, *known]), max([1.0, *known])
    margin = 0.08 * (high - low)
    panel = _Panel(*rows, high + margin, low - margin if low < 0 else 0.0)
    _draw_axis(sheet, panel, title, "{:g}")
    return panel


def _draw_lines(sheet: _Sheet, panel: _Panel, shots: Sequence[ShotCheck], lines: Sequence[_Line]) -> None:
    """Draw numbers over time, a line for each shot, and their labels."""
    right = _RIGHT_PX - 6.0
    for line in reversed(lines):
        sheet.text((right, panel.top - 6), line.label, size=_SMALL_PX, colour=line.colour, anchor="rd")
        right -= sheet.measure(line.label) + 18
        for shot in shots:
            points = []
            for start, end, sample in _find_spans(shot):
                value = getattr(sample, line.name)
                if not math.isnan(value):
                    points += [(sheet.x(start), panel.y(value)), (sheet.x(end), panel.y(value))]
            if points:
                sheet.line(points, line.colour, 2)


def _draw_axis(sheet: _Sheet, panel: _Panel, title: str, form: str) -> None:
    """Draw a panel's title, frame, ticks and grid."""
    sheet.text((_LEFT_PX, panel.top - 6), title, size=_SMALL_PX, anchor="ld")
    low, high = sorted((panel.at_top, panel.at_bottom))
    step = _find_step(high - low, (panel.bottom - panel.top) / _LEAST_STEP_PX)
    for number in range(math.ceil(low / step), math.floor(high / step) + 1):
        y = panel.y(number * step)
        sheet.line([(_LEFT_PX, y), (_RIGHT_PX, y)], _FAINT)
        words = form.format(round(number * step, 6)) if number else "0"
        sheet.text((_LEFT_PX - 12, y), words, size=_SMALL_PX, colour=_GREY, anchor="rm")
    for y in (panel.top, panel.bottom):
        sheet.line([(_LEFT_PX, y), (_RIGHT_PX, y)], _GREY)


def _draw_cuts(sheet: _Sheet, shots: Sequence[ShotCheck], rows: tuple[int, int]) -> None:
    # So many cuts would hide what is between them.
    if len(shots) > (_RIGHT_PX - _LEFT_PX) / 8:
        return
    for shot in shots[1:]:
        x = sheet.x(float(shot.start_s))
        sheet.line([(x, rows[0]), (x, rows[1])], _GREY)


def _draw_time_axis(sheet: _Sheet, y: float) -> None:
    step_s = _find_step(sheet.end_s, 12, _round_time)
    for number in range(math.floor(sheet.end_s / step_s) + 1):
        x = sheet.x(number * step_s)
        sheet.line([(x, y), (x, y + 6)], _GREY)
        words = _shorten_time(number * step_s)
        sheet.text((x, y + 10), words, size=_SMALL_PX, colour=_GREY, anchor="ma")
    sheet.text(((_LEFT_PX + _RIGHT_PX) / 2, y + 36), "time, min:s; lines are cuts", colour=_GREY, anchor="ma")


def _round_up(value: float) -> float:
    """Return the least of 1, 2 and 5 times a power of ten that is not below a value."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(power * digit for digit in (1, 2, 5, 10) if power * digit >= value * (1 - 1e-9))


def _round_time(value_s: float) -> float:
    if value_s <= 10:
        return _round_up(value_s)
    minutes = next((number for number in _MINUTES if 60 * number >= value_s), None)
    return 60 * minutes if minutes else 3600 * _round_up(value_s / 3600)


def _find_step(length: float, most: float, rounded: Callable[[float], float] = _round_up) -> float:
    """Return the distance of ticks, of which at most `most` are on an axis of this length."""
    return rounded(length / most)


def _shorten_time(time_s: float) -> str:
    """Return a time without its tenths if they are 0."""
    return format_time(time_s).removesuffix(".0")
