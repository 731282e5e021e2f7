"""Tests of ray casting against hand-computed geometry, and of the choice of renderer."""

import sys

import numpy as np
import pytest

from stereoweave.errors import StereoweaveError
from stereoweave.stereo import StereoCamera
from stereoweave.synth.props.primitives import boxes, sheet, spheres
from stereoweave.synth.rendering import opengl as renderer
from stereoweave.synth.rendering.effects import PLAIN, Effects
from stereoweave.synth.rendering.raycast import Raycaster
from stereoweave.synth.sets.pair_rendering import SceneRenderer
from stereoweave.synth.sets.renderers import choose_renderer
from stereoweave.synth.viewpoints import PosedRig
from stereoweave.synth.world import Material, Mesh, Sky, World, join_meshes

WHITE = (1.0, 1.0, 1.0)


def ahead(width_px: int = 81, height_px: int = 61) -> PosedRig:
    """Return a rig at the origin that looks along y, with z upwards."""
    camera = StereoCamera(focal_px=50.0, baseline_m=0.2, cx_px=(width_px - 1) / 2, cy_px=(height_px - 1) / 2)
    axes = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    return PosedRig(camera=camera, size_px=(width_px, height_px), position_m=np.zeros(3), axes=axes)


def wall(distance_m: float) -> Mesh:
    x, z = np.meshgrid([-20.0, 20.0], [-20.0, 20.0])
    return sheet(np.stack([x, np.full_like(x, distance_m), z], -1), 0)


def world_of(mesh: Mesh, sun: tuple[float, float, float] = (0.0, -1.0, 0.0), sun_light: float = 0.5) -> World:
    sky = Sky(sun=sun, sun_light=3 * (sun_light,), zenith=WHITE, horizon=WHITE, ground=WHITE)
    return World(mesh=mesh, materials=(Material(texture="plain", tint=(0.5, 0.5, 0.5)),), sky=sky)


def test_depth_at_pixel_centres_is_exact():
    """A ball of radius 1 m, 5 m away, has a depth of 4 m; a wall at 8 m and the sky surround it."""
    ball = spheres(np.array([[0.0, 5, 0]]), 1.0, 0, subdivisions=5).as_target()
    below = wall(8.0)
    below.corners_m[..., 2] = np.minimum(below.corners_m[..., 2], 2.0)
    shot = Raycaster(PLAIN).render_views(world_of(join_meshes([ball, below])), ahead(), (0.0,))[0]
    assert shot.depth_m[30, 40] == pytest.approx(4.0, abs=2e-3)  # the ball consists of flat triangles
    assert shot.depth_m[30, 0] == pytest.approx(8.0, abs=1e-6)
    assert shot.target[30, 40] and not shot.target[30, 0]
    # The wall's top, 2 m high at 8 m, is 12.5 px above the middle.
    assert np.isinf(shot.depth_m[:18]).all() and np.isfinite(shot.depth_m[18:]).all()


def test_the_right_camera_sees_the_ball_shifted_by_its_disparity():
    ball = world_of(boxes(np.array([[0.0, 2.1, 0]]), np.array([[0.41, 0.2, 0.41]]), 0).as_target())
    left, right = Raycaster(PLAIN).render_views(ball, ahead(), (0.0, 1.0))
    assert left.target.sum() > 100
    np.testing.assert_array_equal(right.target, np.roll(left.target, -5, axis=1))  # 50 px * 0.2 m / 2 m


@pytest.mark.parametrize("effects", [PLAIN, Effects()])
def test_light_is_albedo_times_irradiance(effects):
    """A sky of 1 on all sides and a frontal sun of 0.5 give 1.5 times the albedo."""
    from stereoweave.synth.textures.bank import srgb_to_linear, texture_bank

    image = Raycaster(effects).render_views(world_of(wall(2.0)), ahead(), (0.0,))[0].image
    layer = texture_bank().pixels[texture_bank().layer("plain", 0), ..., :3]
    shown = srgb_to_linear(image.astype(np.float32))
    light = (0.25 * shown / (1 - shown)) ** (2 / 3)
    expected = 1.5 * 0.5 * srgb_to_linear(layer.astype(np.float32)).mean((0, 1))
    np.testing.assert_allclose(light.mean((0, 1)), expected, rtol=0.03)


def test_a_box_between_the_sun_and_a_wall_casts_a_shadow():
    """A box between the camera and a wall shades a part of the wall to the left of the box."""
    box = boxes(np.array([[1.0, 2.0, 0]]), np.array([[1.0, 0.02, 1.0]]), 0)
    # Behind the box the sun's rays go on towards -x: on the wall, 2 m behind, the shadow is around x = -1.
    sun = (np.sqrt(0.5), -np.sqrt(0.5), 0.0)
    world = world_of(join_meshes([wall(4.0), box]), sun=sun, sun_light=1.0)
    lit, shadowed = (
        Raycaster(effects).render_views(world, ahead(), (0.0,))[0].image.mean(2)
        for effects in (PLAIN, Effects(samples=1))
    )
    # A metre of the wall is 12.5 px, so the shadow covers columns 40 - 1.5 * 12.5 to 40 - 0.5 * 12.5.
    inside, outside = (slice(26, 35), slice(23, 32)), (slice(26, 35), slice(5, 19))
    assert (lit - shadowed)[inside].min() > 20
    np.testing.assert_array_equal(lit[outside], shadowed[outside])


@pytest.mark.needs_egl
def test_both_renderers_implement_the_protocol():
    assert isinstance(Raycaster(), SceneRenderer)
    made = choose_renderer(PLAIN)
    assert isinstance(made, renderer.OpenGLRenderer) and isinstance(made, SceneRenderer)
    made.close()


def test_without_egl_embree_renders_and_warns(monkeypatch):
    def broken(**_: object) -> None:
        raise Exception("libEGL.so: not found")

    monkeypatch.setattr(renderer.moderngl, "create_context", broken)
    with pytest.warns(UserWarning, match=r"embree.*libEGL.so: not found.*libegl1 libgl1-mesa-dri") as warned:
        assert isinstance(choose_renderer(PLAIN), Raycaster)
    assert len(warned) == 1 and "\n" not in str(warned[0].message)


def test_without_either_renderer_the_error_names_the_packages_to_install(monkeypatch):
    for name in ("opengl", "raycast"):
        monkeypatch.delitem(sys.modules, f"stereoweave.synth.rendering.{name}")
    monkeypatch.setitem(sys.modules, "moderngl", None)
    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    with pytest.raises(
        StereoweaveError, match=r'pip install "stereoweave\[synth\]".*libgl1-mesa-dri'
    ) as raised:
        choose_renderer(PLAIN)
    assert "\n" not in str(raised.value)
