"""Bank of all tileable textures, with colour and height.

Some textures are cut from scikit-image's photographs, whose licences are listed in docs/training-data.md.
"""

import functools
import hashlib
import tempfile
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from stereoweave.arguments import check_choice
from stereoweave.synth.textures import (
    cloth,
    ground,
    lettering,
    metal,
    photographs,
    roofs,
    stone,
    vegetation,
    walls,
    water_and_sky,
)
from stereoweave.synth.textures.tiling import SIDE, Colours, Texture
from stereoweave.system.kernel_cache import cache_folder

BANK_SEED = 20_241_121
_KEPT_DAYS = 30

Procedure = Callable[[np.random.Generator], Texture]
Pixels = UInt8[np.ndarray, "layers side side 4"]

# Photographs that can pass for a surface, a print or a poster.
_PHOTOGRAPHS = (
    "brick", "grass", "gravel", "coins", "coffee", "cat", "astronaut", "camera",
    "text", "rocket", "immunohistochemistry", "coffee", "grass", "camera", "astronaut", "cat",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class TextureFamily:
    """Family of similar textures.

    Attributes:
        variants: for each texture, the function that draws it.
        albedo: range of the mean colour in linear light, from 0 (black) to 1 (white); None keeps the colours
            as drawn.
    """

    variants: tuple[Procedure, ...]
    albedo: tuple[float, float] | None = None


FAMILIES = {
    "rust": TextureFamily(variants=4 * (metal.rust,), albedo=(0.07, 0.13)),
    "paint": TextureFamily(variants=4 * (metal.paint,), albedo=(0.55, 0.72)),
    "steel": TextureFamily(
        variants=(metal.brushed_steel, metal.spangled_steel, metal.scratched_steel, metal.tread_plate),
        albedo=(0.28, 0.42),
    ),
    "concrete": TextureFamily(
        variants=(walls.cast_concrete, walls.cracked_concrete, walls.stained_concrete, walls.paving_slabs),
        albedo=(0.28, 0.40),
    ),
    "plaster": TextureFamily(
        variants=2 * (walls.trowelled_plaster, walls.roughcast_plaster), albedo=(0.45, 0.62)
    ),
    "brick": TextureFamily(variants=4 * (walls.brickwork,), albedo=(0.12, 0.24)),
    "stone": TextureFamily(variants=2 * (stone.rubble_wall, stone.coursed_wall), albedo=(0.16, 0.30)),
    "bark": TextureFamily(
        variants=(
            vegetation.furrowed_bark,
            vegetation.plated_bark,
            vegetation.furrowed_bark,
            vegetation.smooth_bark,
        ),
        albedo=(0.08, 0.14),
    ),
    "wood": TextureFamily(variants=4 * (vegetation.planks,), albedo=(0.15, 0.28)),
    "cloth": TextureFamily(
        variants=(cloth.woven_cloth, cloth.twill, cloth.knitted_cloth, cloth.tartan), albedo=(0.10, 0.24)
    ),
    "leaves": TextureFamily(variants=4 * (vegetation.foliage,), albedo=(0.05, 0.09)),
    "grass": TextureFamily(variants=4 * (vegetation.grass,), albedo=(0.05, 0.10)),
    "soil": TextureFamily(variants=(*3 * (ground.soil,), ground.dried_mud), albedo=(0.07, 0.14)),
    "gravel": TextureFamily(variants=4 * (ground.gravel,), albedo=(0.15, 0.28)),
    "asphalt": TextureFamily(variants=4 * (ground.asphalt,), albedo=(0.06, 0.11)),
    "water": TextureFamily(variants=4 * (water_and_sky.water,), albedo=(0.02, 0.04)),
    "sky": TextureFamily(
        variants=(water_and_sky.cumulus, water_and_sky.cirrus, water_and_sky.cumulus, water_and_sky.overcast)
    ),
    "sign": TextureFamily(
        variants=(
            lettering.notice_board,
            lettering.stencilled_numbers,
            lettering.notice_board,
            lettering.posters,
        ),
        albedo=(0.25, 0.45),
    ),
    "tiles": TextureFamily(
        variants=(roofs.pantiles, roofs.plain_tiles, roofs.slates, roofs.plain_tiles), albedo=(0.09, 0.18)
    ),
    "plain": TextureFamily(variants=3 * (walls.near_plain,), albedo=(0.70, 0.78)),
    "photograph": TextureFamily(
        variants=tuple(functools.partial(photographs.photograph_crop, name) for name in _PHOTOGRAPHS)
    ),
}


@dataclass(frozen=True)
class TextureBank:
    """Bank of all textures.

    Attributes:
        pixels: uint8 [L, 512, 512, 4], sRGB colour and height; a height of 128 is level with the surface.
    """

    pixels: Pixels

    def layer(self, family: str, variant: int) -> int:
        """Return the index of a texture in `pixels`; `variant` is taken modulo the number of variants."""
        check_choice("texture", family, FAMILIES)
        counts = {name: len(each.variants) for name, each in FAMILIES.items()}
        before = list(counts).index(family)
        return sum(list(counts.values())[:before]) + variant % counts[family]


@functools.cache
def texture_bank() -> TextureBank:
    """Return the texture bank, which is identical in every process.

    The bank is drawn once per machine and then read from the user's cache folder.
    """
    file = cache_folder().with_name("textures") / f"{_source_version()}.rgba"
    pixels = _read_cache(file)
    if pixels is None:
        pixels = _draw_all()
        _write_cache(file, pixels)
    return TextureBank(pixels)


def _draw_all() -> Pixels:
    counts = {name: len(family.variants) for name, family in FAMILIES.items()}
    return np.stack([draw_texture(name, k) for name, count in counts.items() for k in range(count)])


def draw_texture(family: str, variant: int) -> UInt8[np.ndarray, "side side 4"]:
    """Draw one texture of a family."""
    rng = np.random.default_rng((BANK_SEED, zlib.crc32(family.encode()), variant))
    levels = FAMILIES[family].variants[variant](rng)
    albedo = FAMILIES[family].albedo
    if albedo is not None:
        levels[..., :3] = _scale_to_albedo(levels[..., :3], rng.uniform(*albedo))
    return np.clip(levels, 0, 255).astype(np.uint8)


def srgb_to_linear(levels: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Convert sRGB levels in 0..255 to linear light in 0..1."""
    values = levels / 255
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def _scale_to_albedo(colours: Colours, albedo: float) -> Colours:
    """Scale sRGB colours so that their mean in linear light equals the albedo."""
    few, gain = colours[::4, ::4], 1.0
    # Linear light is about the 2.2nd power of the levels. Clipping changes the mean, hence the iterations.
    for _ in range(6):
        gain *= float(albedo / srgb_to_linear(np.clip(few * gain, 0, 255)).mean()) ** (1 / 2.2)
    return colours * gain


def _source_version() -> str:
    """Return a hash of the source code of all textures."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:16]


def _read_cache(file: Path) -> Pixels | None:
    """Return the cached textures, or None if the file is missing or damaged."""
    try:
        kept = np.fromfile(file, np.uint8)
    except OSError:
        return None
    count = sum(len(family.variants) for family in FAMILIES.values())
    texels, checksum = kept[:-4], kept[-4:]
    if texels.size != count * SIDE * SIDE * 4 or checksum.tobytes() != _checksum(texels):
        return None
    return texels.reshape(count, SIDE, SIDE, 4)


def _write_cache(file: Path, pixels: Pixels) -> None:
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=file.parent) as folder:
            whole = Path(folder) / file.name
            with whole.open("wb") as stream:
                stream.write(pixels.data)
                stream.write(_checksum(pixels))
            whole.replace(file)
        # Caches of other versions are kept for a while, because versions in alternating use would delete each
        # other's cache.
        for other in file.parent.glob(f"*{file.suffix}"):
            if time.time() - other.stat().st_mtime > _KEPT_DAYS * 86_400:
                other.unlink()
    except OSError:
        # The cache is optional. Without it, each process draws the bank itself.
        return


def _checksum(pixels: UInt8[np.ndarray, "..."]) -> bytes:
    return zlib.crc32(pixels.data).to_bytes(4, "big")
