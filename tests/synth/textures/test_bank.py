import hashlib
import os
import subprocess
import sys

import cv2
import numpy as np
import pytest

from stereoweave.errors import StereoweaveError
from stereoweave.learn.data.textures import PHOTOGRAPHS
from stereoweave.synth.textures import bank as textures
from stereoweave.synth.textures.bank import FAMILIES, TextureFamily, draw_texture, texture_bank
from stereoweave.synth.textures.tiling import (
    SIDE,
    blur,
    distance_to_lines,
    mix,
    noise,
    paint_polygons,
    smear_down,
    smoothstep,
    voronoi_cells,
)

# Mean colour of outdoor surfaces in linear light, from 0 (black) to 1 (white).
ALBEDO = {
    "asphalt": (0.05, 0.12),
    "bark": (0.07, 0.15),
    "brick": (0.1, 0.3),
    "concrete": (0.25, 0.42),
    "gravel": (0.12, 0.3),
    "grass": (0.04, 0.11),
    "leaves": (0.04, 0.1),
    "paint": (0.5, 0.75),
    "plain": (0.68, 0.8),
    "rust": (0.05, 0.15),
    "soil": (0.05, 0.16),
    "stone": (0.14, 0.32),
    "water": (0.01, 0.05),
}
# Upper limits of the median HSV saturation, 0..1. A fire engine has 0.9, and a ripe lemon 0.8.
SATURATION = {"asphalt": 0.1, "concrete": 0.12, "paint": 0.1, "plain": 0.05, "sky": 0.01, "steel": 0.1}
MUTED = 0.6


def layers(*left_out):
    for family, members in FAMILIES.items():
        if family not in left_out:
            for variant in range(len(members.variants)):
                yield f"{family} {variant}", texture_bank().pixels[texture_bank().layer(family, variant)]


def slope(grey):
    """Return the exponent with which amplitude falls with frequency, from 4 to 128 waves per side."""
    amplitude = np.abs(np.fft.fft2(grey - grey.mean()))
    frequency = np.hypot(np.fft.fftfreq(SIDE)[:, None], np.fft.fftfreq(SIDE)) * SIDE
    edges = np.geomspace(4, 128, 11)
    bands = [(frequency >= low) & (frequency < high) for low, high in zip(edges, edges[1:], strict=False)]
    strength = [np.sqrt((amplitude[band] ** 2).mean()) for band in bands]
    return -np.polyfit(np.log(np.sqrt(edges[1:] * edges[:-1])), np.log(strength), 1)[0]


def greatest_seam(pixels):
    """Return the mean step across a border, relative to the largest mean step between lines inside."""
    image = pixels.astype(np.float32)
    seams = []
    for axis in (0, 1):
        inside = np.abs(np.diff(image, axis=axis)).mean(axis=(1 - axis, 2))
        across = np.take(image, 0, axis) - np.take(image, -1, axis)
        seams.append(np.abs(across).mean() / inside.max())
    return max(seams)


def test_every_layer_is_a_different_texture():
    count = sum(len(family.variants) for family in FAMILIES.values())
    assert texture_bank().pixels.shape == (count, 512, 512, 4)
    assert texture_bank().pixels.dtype == np.uint8
    assert len({pixels.tobytes() for _, pixels in layers()}) == count


def test_layers_are_found_by_family_and_by_variant_modulo_the_familys_size():
    np.testing.assert_array_equal(
        texture_bank().pixels[texture_bank().layer("brick", 1)], draw_texture("brick", 1)
    )
    assert texture_bank().layer("brick", 5) == texture_bank().layer("brick", 1)
    places = [
        texture_bank().layer(name, k)
        for name, family in FAMILIES.items()
        for k in range(len(family.variants))
    ]
    assert places == list(range(len(texture_bank().pixels)))


def test_an_unknown_family_is_an_error_that_lists_the_known_ones():
    with pytest.raises(StereoweaveError, match="texture: expected one of rust, paint, .*, found 'marmalade'"):
        texture_bank().layer("marmalade", 0)


def test_every_texture_tiles():
    seams = {name: greatest_seam(pixels) for name, pixels in layers()}
    assert {name: seam for name, seam in seams.items() if seam > 1.1} == {}


@pytest.mark.parametrize("family", ["rust", "leaves", "stone", "water", "photograph"])
def test_a_part_of_a_texture_does_not_tile(family):
    assert greatest_seam(texture_bank().pixels[texture_bank().layer(family, 0), :400, :400]) > 1.3


def test_textures_have_structure_at_every_scale_as_photographs_do():
    slopes = {name: slope(pixels[..., :3].mean(-1)) for name, pixels in layers("photograph")}
    assert {name: found for name, found in slopes.items() if not 0.5 < found < 1.6} == {}


def test_no_family_is_garish():
    for name, pixels in layers():
        saturation = cv2.cvtColor(np.ascontiguousarray(pixels[..., :3]), cv2.COLOR_RGB2HSV)[..., 1] / 255
        assert np.median(saturation) <= SATURATION.get(name.split()[0], MUTED), name
        assert np.quantile(saturation, 0.95) < 0.7, name


def test_surfaces_are_as_light_and_dark_as_in_nature():
    for name, pixels in layers():
        low, high = ALBEDO.get(name.split()[0], (0, 1))
        encoded = pixels[..., :3] / 255
        light = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
        assert low < light.mean() < high, name


def test_few_texels_of_surfaces_are_clipped_to_black_or_white():
    for name, pixels in layers("sky", "sign", "photograph"):
        grey = pixels[..., :3].mean(-1)
        assert ((grey < 1) | (grey > 254)).mean() < 0.04, name


def test_the_sky_is_grey_and_has_no_height():
    for variant in range(len(FAMILIES["sky"].variants)):
        pixels = texture_bank().pixels[texture_bank().layer("sky", variant)]
        assert (np.ptp(pixels[..., :3], axis=-1) == 0).all()
        assert (pixels[..., 3] == 128).all()


def test_mortar_lies_lower_than_bricks():
    # With 20 courses, joints are at multiples of 25.6 rows, and the middles of bricks 12.8 rows below them.
    for variant in range(4):
        height = texture_bank().pixels[texture_bank().layer("brick", variant), ..., 3].mean(axis=1)
        joints = np.round(np.arange(20) * 25.6).astype(int)
        assert height[joints].mean() < height[joints + 13].mean() - 40


def test_chips_in_paint_are_darker_and_lower_than_the_paint():
    for variant in range(4):
        pixels = texture_bank().pixels[texture_bank().layer("paint", variant)]
        chips = pixels[..., 3] < 90
        assert 0 < chips.mean() < 0.1
        assert pixels[chips, :3].mean() < 0.7 * pixels[~chips, :3].mean()


@pytest.mark.parametrize(("family", "variant"), [("leaves", 1), ("sign", 0), ("photograph", 3)])
def test_another_process_draws_the_same_bytes(family, variant):
    code = (
        "import hashlib; from stereoweave.synth.textures.bank import draw_texture; "
        f"print(hashlib.sha256(draw_texture({family!r}, {variant}).tobytes()).hexdigest())"
    )
    there = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert there.strip() == hashlib.sha256(draw_texture(family, variant).tobytes()).hexdigest()


def test_all_photographs_have_a_known_licence():
    used = {procedure.args[0] for procedure in FAMILIES["photograph"].variants}
    assert used <= set(PHOTOGRAPHS)


def test_importing_the_textures_does_not_import_scikit_image():
    code = "import sys, stereoweave.synth.textures.bank; assert 'skimage' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.fixture
def small_bank(tmp_path, monkeypatch):
    """Return the cache folder of a bank of one texture, and a list that grows with each drawing."""
    drawn, (plain, *_) = [], FAMILIES["plain"].variants

    def once(rng):
        drawn.append(1)
        return plain(rng)

    monkeypatch.setattr(textures, "FAMILIES", {"plain": TextureFamily(variants=(once,), albedo=(0.7, 0.8))})
    monkeypatch.setattr(textures, "cache_folder", lambda: tmp_path / "kernels")
    return tmp_path / "textures", drawn


def fresh_bank():
    """Return the bank as a new process would see it."""
    return texture_bank.__wrapped__().pixels


def test_a_cached_bank_is_read_and_not_drawn_again(small_bank):
    folder, drawn = small_bank
    first = fresh_bank()
    assert [file.suffix for file in folder.iterdir()] == [".rgba"]
    np.testing.assert_array_equal(fresh_bank(), first)
    assert len(drawn) == 1


@pytest.mark.parametrize(
    "damage",
    [
        lambda kept: b"",
        lambda kept: bytes(4),
        lambda kept: kept[: len(kept) // 2],
        lambda kept: kept + b"more",
        lambda kept: kept[:1000] + bytes([kept[1000] ^ 1]) + kept[1001:],
    ],
    ids=["empty", "four zeros", "cut", "grown", "one bit"],
)
def test_a_damaged_file_is_replaced(small_bank, damage):
    folder, drawn = small_bank
    first = fresh_bank()
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    np.testing.assert_array_equal(fresh_bank(), first)
    assert len(drawn) == 2
    assert file.read_bytes() == whole


def test_changed_code_draws_a_new_bank_and_removes_banks_older_than_a_month(small_bank, monkeypatch):
    folder, drawn = small_bank
    month_s = 31 * 24 * 60 * 60
    for version, age_s in [("oldest", 2 * month_s), ("old", 0), ("new", 0)]:
        monkeypatch.setattr(textures, "_source_version", lambda version=version: version)
        fresh_bank()
        written_s = (folder / f"{version}.rgba").stat().st_mtime
        os.utime(folder / f"{version}.rgba", (written_s, written_s - age_s))
    assert len(drawn) == 3
    assert sorted(file.name for file in folder.iterdir()) == ["new.rgba", "old.rgba"]


def test_the_bank_is_drawn_if_it_cannot_be_cached(small_bank):
    folder, drawn = small_bank
    folder.write_text("a file where the folder should be")
    np.testing.assert_array_equal(fresh_bank(), fresh_bank())
    assert len(drawn) == 2


@pytest.mark.parametrize("exponent", [0.5, 1.0, 1.5])
def test_noise_has_the_requested_spectrum(rng, exponent):
    values = noise(rng, exponent)
    assert abs(slope(values) - exponent) < 0.1
    assert abs(values.mean()) < 1e-4
    assert abs(values.std() - 1) < 1e-4


def test_stretched_noise_is_longer_than_wide(rng):
    values = noise(rng, 1.0, 4, stretch=(8, 1))
    assert np.abs(np.diff(values, axis=0)).mean() < 0.5 * np.abs(np.diff(values, axis=1)).mean()


def test_each_texel_belongs_to_the_cell_of_its_nearest_site(rng):
    # Without jitter, the cells are squares of 64 texels, so their middles are 32 texels from the border.
    found = voronoi_cells(rng, 8, 8, jitter=0)
    assert found.number == 64
    assert (found.label[1:63, 1:63] == found.label[32, 32]).all()
    assert found.label[32, 66] != found.label[32, 32]
    assert abs(found.rim[32, 32] - 32) < 1.5
    np.testing.assert_array_equal(found.per_texel(np.arange(64)), found.label)


def test_polygons_across_a_border_continue_at_the_opposite_one():
    canvas = np.zeros((SIDE, SIDE, 4), np.uint8)
    square = np.array([[[-10.0, 100.0], [10.0, 100.0], [10.0, 120.0], [-10.0, 120.0]]])
    paint_polygons(canvas, square, np.array([[200.0, 150.0, 100.0, 50.0]]))
    for x in (0, 5, SIDE - 5, SIDE - 1):
        assert canvas[110, x].tolist() == [200, 150, 100, 50]
    assert not canvas[110, 20 : SIDE - 20].any()


def test_smearing_keeps_the_sum_and_continues_at_the_top():
    source = np.zeros((SIDE, SIDE), np.float32)
    source[SIDE - 1, 7] = 1
    run = smear_down(source, 30)
    assert abs(run.sum() - 1) < 1e-4
    # After 30 texels, 1 / e of the strength is left.
    assert abs(run[29, 7] / run[SIDE - 1, 7] - np.exp(-1)) < 1e-3


def test_blur_keeps_the_mean_and_crosses_the_border():
    source = np.zeros((SIDE, SIDE), np.float32)
    source[0, 0] = 1
    soft = blur(source, 2.0)
    assert abs(soft.sum() - 1) < 1e-4
    assert abs(soft[-1, -1] - soft[1, 1]) < 1e-7


def test_smoothsteps_line_distances_and_mixtures_have_known_values():
    values = np.array([[0.0, 1.5], [2.0, 9.0]], np.float32)
    np.testing.assert_allclose(smoothstep(1, 2, values), [[0, 0.5], [1, 1]])
    np.testing.assert_allclose(smoothstep(2, 1, values), [[1, 0.5], [0, 0]])
    np.testing.assert_allclose(
        distance_to_lines(np.array([[0.0, 3.0], [9.0, 12.0]]), 2, 10), [[2, 1], [3, 0]]
    )
    half = np.full((1, 1), 0.25, np.float32)
    np.testing.assert_allclose(mix((0, 100, 40), (100, 0, 40), half), [[[25, 75, 40]]])
