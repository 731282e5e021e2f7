"""Textures with lettering: sign plates, stencilled numbers and posters."""

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from stereoweave.synth.textures.tiling import (
    SIDE,
    Colour,
    Map,
    Texture,
    mix,
    noise,
    smoothstep,
    stack_texture,
)
from stereoweave.synth.textures.wear import dirt_map

Box = tuple[int, int, int, int]  # left, top, right, bottom

_SIGN_COLOURS: tuple[tuple[Colour, Colour], ...] = (
    ((228, 226, 218), (42, 40, 40)),
    ((190, 168, 104), (40, 38, 36)),
    ((74, 94, 120), (226, 226, 220)),
    ((70, 94, 80), (224, 226, 216)),
    ((138, 74, 66), (230, 224, 214)),
    ((86, 84, 80), (216, 212, 200)),
)


_WORDS = (
    "DANGER", "Harbour Office", "No parking", "Keep clear", "EXIT", "Platform", "Museum", "PRIVATE",
    "Bakery", "Mind the step", "Ticket hall", "HIGH VOLTAGE", "Fish & chips", "To the ferry", "Reception",
    "Gate", "Library", "Workshop", "Deliveries", "Open 9 - 17", "Caution", "Fire door", "Weighbridge",
)  # fmt: skip


def notice_board(rng: np.random.Generator) -> Texture:
    """Draw a board covered with sign plates."""
    page = Image.new("RGB", (SIDE, SIDE), (118, 112, 102))
    mask = Image.new("L", (SIDE, SIDE), 0)
    tall = SIDE // int(rng.choice([4, 5, 6]))
    for top in range(0, SIDE - tall + 1, tall):
        left = 0
        while left < SIDE - 60:
            wide = min(int(rng.uniform(1.2, 3.2) * tall), SIDE - left)
            _paint_plate(rng, page, mask, (left + 4, top + 4, left + wide - 5, top + tall - 5))
            left += wide
    return _weather_print(rng, page, 0.4 * np.asarray(mask, np.float32) / 255)


def stencilled_numbers(rng: np.random.Generator) -> Texture:
    """Draw large stencilled letters and numbers on a plain background, as on containers and hulls."""
    ground, ink = _SIGN_COLOURS[rng.integers(len(_SIGN_COLOURS))]
    page = Image.new("RGB", (SIDE, SIDE), _integer_colour(ground))
    pen = ImageDraw.Draw(page)
    top = 8
    while top < SIDE - 30:
        size = min(int(rng.choice([36, 64, 110, 150])), SIDE - top - 8)
        letters = "".join(rng.choice(list("ABCDEHKLMNPRSTUX"), rng.integers(2, 5)))
        text = f"{letters} {rng.integers(10, 9999)}-{rng.integers(1, 9)}"
        _write_text(pen, (12, top, SIDE - 12, top + size), text, ink)
        top += size + int(rng.integers(6, 24))
    return _weather_print(rng, page, np.zeros((SIDE, SIDE), np.float32))


def posters(rng: np.random.Generator) -> Texture:
    """Draw a grid of four posters, each with a headline above small print."""
    page = Image.new("RGB", (SIDE, SIDE), (150, 140, 124))
    pen = ImageDraw.Draw(page)
    for left in (0, SIDE // 2):
        for top in (0, SIDE // 2):
            box = (left + 3, top + 3, left + SIDE // 2 - 4, top + SIDE // 2 - 4)
            _paint_bill(rng, pen, box)
    return _weather_print(rng, page, np.zeros((SIDE, SIDE), np.float32))


def _integer_colour(colour: Colour) -> tuple[int, int, int]:
    red, green, blue = (int(level) for level in colour)
    return red, green, blue


def _write_text(pen: ImageDraw.ImageDraw, box: Box, text: str, ink: Colour) -> None:
    """Write text centred in a box, in the largest size that fits."""
    wide, high = box[2] - box[0], box[3] - box[1]
    font = ImageFont.load_default(100)
    left, top, right, bottom = font.getbbox(text)
    size = 100 * min(wide / (right - left), high / (bottom - top))
    middle = ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2)
    pen.text(middle, text, fill=_integer_colour(ink), font=ImageFont.load_default(max(size, 6)), anchor="mm")


def _paint_plate(rng: np.random.Generator, page: Image.Image, mask: Image.Image, box: Box) -> None:
    ground, ink = _SIGN_COLOURS[rng.integers(len(_SIGN_COLOURS))]
    pen = ImageDraw.Draw(page)
    radius = int(rng.integers(0, 12))
    pen.rounded_rectangle(box, radius, fill=_integer_colour(ground))
    ImageDraw.Draw(mask).rounded_rectangle(box, radius, fill=255)
    if rng.random() < 0.6:
        frame = (box[0] + 4, box[1] + 4, box[2] - 4, box[3] - 4)
        pen.rounded_rectangle(frame, radius, outline=_integer_colour(ink), width=2)
    lines = int(rng.integers(1, 4))
    high = (box[3] - box[1] - 16) // lines
    for k in range(lines):
        text = str(rng.choice(_WORDS)) if rng.random() < 0.75 else f"{rng.integers(1, 999)}"
        top = box[1] + 8 + k * high
        _write_text(pen, (box[0] + 12, top + 2, box[2] - 12, top + high - 2), text, ink)


def _paint_bill(rng: np.random.Generator, pen: ImageDraw.ImageDraw, box: Box) -> None:
    # Most posters are printed on pale paper.
    ground, ink = _SIGN_COLOURS[rng.choice([0, 0, 0, 1, 2, 4])]
    pen.rectangle(box, fill=_integer_colour(ground))
    left, top, right, bottom = box[0] + 10, box[1] + 8, box[2] - 10, box[3] - 8
    head = int(rng.integers(30, 80))
    _write_text(pen, (left, top, right, top + head), str(rng.choice(_WORDS)), ink)
    size = int(rng.integers(8, 15))
    font = ImageFont.load_default(size)
    for line in range(top + head + 8, bottom - size, int(1.35 * size)):
        text = " ".join(rng.choice(_WORDS, 6))
        while font.getlength(text) > right - left:
            text = text[:-1]
        pen.text((left, line), text, fill=_integer_colour(ink), font=font)


def _weather_print(rng: np.random.Generator, page: Image.Image, height: Map) -> Texture:
    """Fade and scuff a printed page, and return it as a texture."""
    colours = np.asarray(page, np.float32)
    faded = 0.12 * smoothstep(-1, 2, noise(rng, 1.6, 2))
    colours = mix(colours, (176, 170, 160), faded)
    scuffs = smoothstep(2.3, 2.8, noise(rng, 0.8, 12) + 0.4 * noise(rng, 1.5, 3))
    colours = mix(colours, (148, 140, 130), 0.7 * scuffs)
    colours *= (1 - 0.22 * dirt_map(rng) + 0.02 * noise(rng, 0.6))[..., None]
    return stack_texture(colours, height + 0.03 * noise(rng) - 0.1 * scuffs)
