"""Tests of the OpenGL renderer against hand-computed geometry, ray casting and itself."""

import functools
from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from second_casts import from_the_other_eye

from stereoweave.errors import StereoweaveError
from stereoweave.stereo import StereoCamera
from stereoweave.synth.props.primitives import boxes, sheet, spheres, tubes
from stereoweave.synth.rendering.effects import PLAIN, Effects
from stereoweave.synth.rendering.opengl import OpenGLRenderer
from stereoweave.synth.rendering.raycast import Raycaster
from stereoweave.synth.scenes import SCENES
from stereoweave.synth.sets.pair_rendering import RenderSpec, draw_stage_and_rig
from stereoweave.synth.textures.bank import srgb_to_linear, texture_bank
from stereoweave.synth.viewpoints import Orbit, PosedRig, Viewpoint, place_rig
from stereoweave.synth.world import Fog, Lamp, Material, Mesh, Sky, World, join_meshes

pytestmark = pytest.mark.needs_egl

WHITE = (1.0, 1.0, 1.0)
BLACK = (0.0, 0.0, 0.0)
SKY = Sky(
    sun=(0.6, 0.0, 0.8),
    sun_light=(0.8, 0.75, 0.7),
    zenith=(0.2, 0.3, 0.5),
    horizon=(0.6, 0.6, 0.6),
    ground=WHITE,
)


@pytest.fixture(scope="module")
def renderer() -> Iterator[OpenGLRenderer]:
    made = OpenGLRenderer()
    yield made
    made.close()


@pytest.fixture(scope="module")
def plain() -> Iterator[OpenGLRenderer]:
    made = OpenGLRenderer(PLAIN)
    yield made
    made.close()


@pytest.fixture(scope="module")
def small_scene(plain) -> Callable[[str], tuple[World, PosedRig]]:
    @functools.cache
    def world_and_rig(name: str) -> tuple[World, PosedRig]:
        stage, rig = draw_stage_and_rig(plain, RenderSpec(scene=name, size_px=(160, 120)), 0)
        return stage.world, rig

    return world_and_rig


@pytest.fixture
def make() -> Iterator[Callable[[Effects], OpenGLRenderer]]:
    made = []

    def renderer_with(effects: Effects) -> OpenGLRenderer:
        made.append(OpenGLRenderer(effects))
        return made[-1]

    yield renderer_with
    for each in made:
        each.close()


def ahead(
    size_px: tuple[int, int] = (160, 120), focal_px: float = 100.0, baseline_m: float = 0.2
) -> PosedRig:
    """Return a rig at the origin that looks along y, with z upwards."""
    width_px, height_px = size_px
    camera = StereoCamera(
        focal_px=focal_px, baseline_m=baseline_m, cx_px=(width_px - 1) / 2, cy_px=(height_px - 1) / 2
    )
    axes = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    return PosedRig(camera=camera, size_px=size_px, position_m=np.zeros(3), axes=axes)


def orbiting(size_px: tuple[int, int] = (320, 240)) -> PosedRig:
    place = Viewpoint(
        distance_m=8, azimuth_deg=-65, elevation_deg=14, aim_m=np.array([0, 0, 2.0]), roll_deg=1.5
    )
    camera = StereoCamera(
        focal_px=0.95 * size_px[0], baseline_m=0.4, cx_px=(size_px[0] - 1) / 2, cy_px=(size_px[1] - 1) / 2
    )
    return place_rig(Orbit(centre_m=(0, 0, 2), distance_m=(5, 12)), place, camera, size_px)


def wall(
    distance_m: float, left_m: float = -20, right_m: float = 20, material: int = 0, steps: int = 2
) -> Mesh:
    """Return an upright wall across the view of `ahead` that faces the camera."""
    x, z = np.meshgrid(np.linspace(left_m, right_m, steps), np.linspace(-20, 20, steps))
    return sheet(np.stack([x, np.full_like(x, distance_m), z], -1), material)


def world_of(mesh: Mesh, *materials: Material, **others: object) -> World:
    return World(mesh=mesh, materials=materials or (Material(texture="brick"),), **{"sky": SKY, **others})


def cluttered(rng: np.random.Generator) -> World:
    starts, ends = rng.uniform(-2.5, 2.5, (2, 120, 3)) + [0, 0, 2.5]
    x, y = np.meshgrid(np.linspace(-40, 40, 21), np.linspace(-40, 40, 21))
    mesh = join_meshes(
        [
            sheet(np.stack([x, y, 0.1 * np.sin(x)], -1), 0),
            tubes(starts, ends, 0.03, 1).as_target(),
            boxes(rng.uniform(-2, 2, (12, 3)) + [0, 0, 2], rng.uniform(0.2, 0.8, (12, 3)), 2).as_target(),
            spheres(rng.uniform(-2, 2, (12, 3)) + [0, 0, 2], rng.uniform(0.2, 0.5, 12), 3).as_target(),
        ]
    )
    return world_of(
        mesh,
        Material(texture="grass", roughness=0.95),
        Material(texture="steel", roughness=0.3, metal=1.0),
        Material(texture="brick", roughness=0.9),
        Material(texture="paint", tint=(0.6, 0.1, 0.08), roughness=0.3),
        lamps=(Lamp(position_m=(1, -3, 3), light=(0.5, 0.5, 0.4)),),
        fog=Fog(colour=(0.6, 0.6, 0.6), density_per_m=0.01),
    )


def level(light: float) -> float:
    """Return the sRGB level of light at exposure 1: the tone curve, then the sRGB transfer function."""
    shown = light**1.5 / (light**1.5 + 0.25)
    return 255 * (1.055 * shown ** (1 / 2.4) - 0.055)


def light_of(image: np.ndarray) -> np.ndarray:
    shown = srgb_to_linear(image.astype(np.float32))
    return (0.25 * shown / (1 - shown)) ** (2 / 3)


def test_a_wall_at_4_m_has_a_depth_of_4_m_everywhere(plain):
    rig = ahead(focal_px=100.0, baseline_m=0.2)
    depth_m = plain.depth_m(world_of(wall(4.0)), rig, 0.0)
    np.testing.assert_allclose(depth_m, 4.0, atol=2e-6)
    np.testing.assert_allclose(rig.camera.disparity_px(depth_m), 5.0, atol=2e-5)  # 100 px * 0.2 m / 4 m


def test_a_box_hides_the_wall_behind_it(plain):
    # The box's front is at 2 m, where 1 cm is half a pixel: 20.5 px to each side of the middle.
    box = boxes(np.array([[0, 2.2, 0]]), np.array([[0.82, 0.4, 0.42]]), 0).as_target()
    left, right = plain.render_views(
        world_of(join_meshes([wall(4.0), box])), ahead(size_px=(161, 121)), (0.0, 1.0)
    )
    expected = np.zeros((121, 161), bool)
    expected[50:71, 60:101] = True
    np.testing.assert_array_equal(left.target, expected)
    np.testing.assert_allclose(left.depth_m, np.where(expected, 2.0, 4.0), atol=2e-6)
    # 100 px * 0.2 m / 2 m
    np.testing.assert_array_equal(right.target, np.roll(expected, -10, axis=1))


def test_a_pixel_shows_the_surface_at_its_centre(plain):
    # The wall's edges, 1 m away, are just left of columns 79.5 - 49.5 = 30 and 79.5 + 20.5 = 100.
    columns = plain.depth_m(world_of(wall(1.0, -0.4951, 0.2049)), ahead(), 0.0)[60] == 1.0
    np.testing.assert_array_equal(np.flatnonzero(columns), np.arange(30, 100))


def test_the_sky_is_infinitely_far(plain):
    depth_m = plain.depth_m(world_of(boxes(np.array([[0, -5.0, 0]]), np.ones((1, 3)), 0)), ahead(), 0.0)
    assert np.isinf(depth_m).all() and (depth_m > 0).all()


def test_a_world_without_a_sun_looks_like_one_with_a_very_faint_sun(renderer, rng):
    world, rig = cluttered(rng), orbiting()
    without, faint = (
        renderer.render_views(replace(world, sky=replace(world.sky, sun_light=3 * (light,))), rig, (0.0,))[
            0
        ].image
        for light in (0.0, 1e-12)
    )
    np.testing.assert_array_equal(without, faint)


def test_positions_lie_on_the_baseline(plain):
    columns = [
        np.flatnonzero(
            np.isfinite(plain.depth_m(world_of(wall(1.0, -0.2, 0.2)), ahead(), position)[60])
        ).min()
        for position in (0.0, 0.5, 1.0, -0.5)
    ]
    assert np.diff(columns).tolist() == [-10, -10, 30]  # 100 px * 0.2 m / 1 m between the cameras


@pytest.mark.parametrize("position", [0, 1])
@pytest.mark.parametrize("name", ["clutter", *SCENES])
def test_depth_equals_the_depth_from_ray_casting(plain, small_scene, rng, name, position):
    world, rig = (cluttered(rng), orbiting()) if name == "clutter" else small_scene(name)
    disparity_px, expected_px = (
        rig.camera.disparity_px(camera.depth_m(world, rig, position)) for camera in (plain, Raycaster())
    )
    inside = ~_beside_edges(expected_px)
    assert inside.mean() > 0.4
    assert np.mean(np.abs(disparity_px - expected_px)[inside] < 0.001) >= 0.999


@pytest.mark.parametrize("position", [0, 1])
@pytest.mark.parametrize("name", SCENES)
def test_the_two_disparities_agree_where_both_cameras_see_a_surface(plain, small_scene, name, position):
    """One camera's disparity equals the other's wherever both see the same triangle."""
    world, rig = small_scene(name)
    disparity_px = rig.camera.disparity_px(plain.depth_m(world, rig, position))
    there_px, same = from_the_other_eye(world, rig, disparity_px, position)
    assert same.mean() > 0.1
    assert np.mean(np.abs(there_px - disparity_px)[same] < 0.05) >= 0.999


@pytest.mark.parametrize("samples", [1, 2])
def test_diffuse_images_are_not_shifted_against_their_ground_truth(make, samples):
    """After warping the right image by the disparity, a least-squares fit finds no remaining shift."""
    diffuse = make(Effects(gloss=False, fog=False, samples=samples))
    x, z = np.meshgrid(np.linspace(-6, 6, 9), np.linspace(-4, 4, 9))
    slanted = sheet(np.stack([x, 5 + 0.35 * x + 0.1 * np.sin(3 * z), z], -1), 0)
    rig = ahead(size_px=(640, 480), focal_px=600.0, baseline_m=0.3)
    world = world_of(slanted, Material(texture="photograph", span_m=4.0, relief=0.2))
    left, right = diffuse.render_views(world, rig, (0.0, 1.0))
    disparity_px = rig.camera.disparity_px(left.depth_m)
    columns = np.arange(640)
    seen, other = (shot.image.mean(2) for shot in (left, right))
    # cv2.remap is not used, because it shifts images by 1/64 px on average.
    warped = np.stack(
        [np.interp(columns - d, columns, row) for d, row in zip(disparity_px, other, strict=True)]
    )
    inside = (slice(10, -10), slice(80, -10))
    for axis in (0, 1):
        slope = np.gradient((seen + warped) / 2, axis=axis)[inside]
        assert abs((slope * (seen - warped)[inside]).sum() / (slope**2).sum()) < 0.01


def test_a_shadow_falls_where_geometry_predicts(plain, make):
    """The sun is 45 degrees high towards +x, so a slab at a height of 2 m casts its shadow 2 m towards -x."""
    sky = replace(SKY, sun=(np.sqrt(0.5), 0.0, np.sqrt(0.5)))
    x, y = np.meshgrid([-9.0, 9.0], [-9.0, 9.0])
    ground = sheet(np.stack([x, y, 0 * x], -1), 0)
    slab = boxes(np.array([[0, 0, 2.0]]), np.array([[1.0, 1.0, 0.02]]), 0).as_target()
    down = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    rig = replace(ahead(size_px=(161, 161)), position_m=np.array([0, 0, 10.0]), axes=down)
    shadowing = make(replace(PLAIN, shadows=True))
    world = world_of(join_meshes([ground, slab]), sky=sky)
    shadowed, lit, dark = (
        camera.render_views(stage, rig, (0.0,))[0].image.astype(int)
        for camera, stage in (
            (shadowing, world),
            (plain, world),
            (shadowing, replace(world, sky=replace(sky, sun_light=BLACK))),
        )
    )
    # 1 m on the ground is 10 px; the slab itself covers columns 74 to 86.
    np.testing.assert_array_equal(shadowed[76:85, 56:65], dark[76:85, 56:65])
    beside = np.ones((161, 161), bool)
    beside[72:89, 52:89] = False
    np.testing.assert_array_equal(shadowed[beside], lit[beside])
    assert (lit - shadowed)[76:85, 56:65].min() > 20


def test_enclosed_places_get_less_light_from_the_sky(plain, make):
    """The effect darkens the floor under a table and leaves the open floor as it is."""
    x, y = np.meshgrid([-9.0, 9.0], [-9.0, 9.0])
    floor = sheet(np.stack([x, y, 0 * x], -1), 0)
    table = boxes(np.array([[0, 4.0, 0.45]]), np.array([[3.0, 3.0, 0.1]]), 0).as_target()
    evenly = replace(SKY, sun_light=BLACK, zenith=WHITE, horizon=WHITE)
    rig = replace(ahead(), position_m=np.array([0, -2.0, 0.3]))
    world = world_of(join_meshes([floor, table]), Material(texture="plain"), sky=evenly)
    open_to_the_sky, crowded = (
        light_of(camera.render_views(world, rig, (0.0,))[0].image)
        for camera in (plain, make(replace(PLAIN, ambient_occlusion=True)))
    )
    under, beside = (slice(64, 66), slice(70, 90)), (slice(90, 110), slice(70, 90))
    assert crowded[under].mean() < 0.8 * open_to_the_sky[under].mean()
    np.testing.assert_allclose(crowded[beside].mean(), open_to_the_sky[beside].mean(), rtol=0.03)


def test_only_gloss_differs_between_the_cameras(plain, make):
    """Both cameras see the same colours on a wall, except for highlights and reflections."""
    rig = ahead(baseline_m=1.0)
    paint = Material(texture="paint", roughness=0.3, relief=0.0)
    lamps = (Lamp(position_m=(0.5, 1.0, 0.0), light=(3.0, 3.0, 3.0)),)
    for camera, gloss in ((plain, False), (make(replace(PLAIN, gloss=True)), True)):
        # The disparity, 100 px * 1 m / 5 m, is whole, so samples fall on the same places of the wall.
        shots = camera.render_views(world_of(wall(5.0), paint, lamps=lamps), rig, (0.0, 1.0))
        left, right = (shot.image.astype(int) for shot in shots)
        differs = np.abs(left[:, 20:] - right[:, :-20]).max() > 3
        assert differs == gloss


def test_fog_adds_its_colour_with_distance(plain, make):
    """At 5 m, exp(-0.1 * 5) = 0.6065 of the black wall and 0.3935 of the fog's 0.5 give 0.1967."""
    world = world_of(
        wall(5.0),
        Material(texture="plain", tint=BLACK),
        fog=Fog(colour=(0.5, 0.5, 0.5), density_per_m=0.1),
    )
    for camera, expected in ((make(replace(PLAIN, fog=True)), level(0.1967)), (plain, 0)):
        image = camera.render_views(world, ahead(size_px=(161, 121)), (0.0,))[0].image
        np.testing.assert_allclose(image[60, 80], expected, atol=1)


@pytest.mark.parametrize("span_m", [0.5, 4.0])
def test_a_texture_keeps_its_mean_colour(plain, span_m):
    """Under a white sky a wall has its tint times its texture's mean, for coarse and fine textures."""
    even = replace(SKY, sun_light=BLACK, zenith=WHITE, horizon=WHITE)
    world = world_of(wall(5.0), Material(texture="concrete", tint=(0.9, 0.7, 0.5), span_m=span_m), sky=even)
    image = plain.render_views(world, ahead(size_px=(160, 160)), (0.0,))[0].image
    layer = texture_bank().pixels[texture_bank().layer("concrete", 0), ..., :3]
    expected = np.array([0.9, 0.7, 0.5]) * srgb_to_linear(layer.astype(np.float32)).mean((0, 1))
    np.testing.assert_allclose(light_of(image).mean((0, 1)), expected, rtol=0.04)


def test_a_plain_rendering_equals_ray_casting(plain):
    """Diffuse colours in sun and sky without shadows agree, but texels are filtered differently."""
    world = replace(cluttered(np.random.default_rng(3)), lamps=())
    world = replace(world, sky=replace(SKY, clouds=0.0))
    shot, expected = (
        camera.render_views(world, orbiting(), (0.0,))[0] for camera in (plain, Raycaster(PLAIN))
    )
    difference = shot.image.astype(int) - expected.image
    assert np.abs(difference.mean()) < 2
    assert np.median(np.abs(difference)) < 8


def test_the_bytes_do_not_depend_on_earlier_renderings(renderer, plain, make):
    worlds = [cluttered(np.random.default_rng(seed)) for seed in range(2)]
    rig = orbiting((160, 120))
    first = renderer.render_views(worlds[0], rig, (0.0, 1.0))
    plain.render_views(worlds[0], rig, (0.0,))
    renderer.render_views(worlds[1], orbiting((96, 64)), (0.5,))
    for again in (
        renderer.render_views(worlds[0], rig, (0.0, 1.0)),
        make(Effects()).render_views(worlds[0], rig, (0.0, 1.0)),
    ):
        for one, other in zip(first, again, strict=True):
            for name in ("image", "depth_m", "target"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_a_view_does_not_depend_on_the_other_views(renderer, rng):
    world, rig = cluttered(rng), orbiting((160, 120))
    alone = renderer.render_views(world, rig, (1.0,))[0]
    np.testing.assert_array_equal(alone.image, renderer.render_views(world, rig, (0.0, 1.0))[1].image)


@pytest.mark.parametrize(
    ("others", "message"),
    [
        (
            {"materials": 65 * (Material(texture="rust"),)},
            "world: expected at most 64 materials, found 65",
        ),
        (
            {"lamps": 5 * (Lamp(position_m=(0, 0, 1), light=WHITE),)},
            "world: expected at most 4 lamps, found 5",
        ),
    ],
)
def test_more_materials_or_lamps_than_a_world_may_have_are_an_error(plain, others, message):
    with pytest.raises(StereoweaveError, match=message):
        plain.render_views(replace(world_of(wall(4.0)), **others), ahead(), (0.0,))


def test_a_pixel_has_one_sample_or_2x2():
    with pytest.raises(StereoweaveError, match="samples: expected 1 or 2, found 3"):
        Effects(samples=3)


def _beside_edges(disparity_px: np.ndarray) -> np.ndarray:
    """Return the mask of pixels whose neighbourhood spans more than half a pixel of disparity."""
    values, window = disparity_px.astype(np.float32), np.ones((3, 3))
    return cv2.dilate(values, window) - cv2.erode(values, window) > 0.5
