"""Off-screen OpenGL renderer of images and exact depth; with Mesa it needs no graphics card."""

from collections.abc import Sequence
from typing import Any

import moderngl
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from stereoweave.errors import StereoweaveError
from stereoweave.synth.rendering.effects import Effects
from stereoweave.synth.rendering.frustum import direction_matrix, projection, triangles_in_view
from stereoweave.synth.rendering.gpu_buffers import FrameBuffers, Geometry, MaterialBlock, upload_textures
from stereoweave.synth.rendering.light_maps import LightMaps
from stereoweave.synth.rendering.shader_programs import Programs, surface_program
from stereoweave.synth.textures.bank import texture_bank
from stereoweave.synth.viewpoints import PosedRig
from stereoweave.synth.world import RenderedView, World

_TEXTURES, _SAMPLES = 0, 1  # texture units


class OpenGLRenderer:
    """OpenGL renderer of worlds; implements `pair_rendering.SceneRenderer`.

    The rendered bytes depend on the world and the rig alone, not on earlier renderings. Depth is rasterised
    separately, at pixel centres. By default, images have 2x2 samples per pixel, arranged around the pixel's
    centre, and each sample is shaded. This smooths highlights and shadow edges. With llvmpipe, it takes
    little more than half the time of multisampling, which also shades surfaces that are covered later.
    """

    def __init__(self, effects: Effects = Effects()) -> None:  # noqa: B008, frozen
        self.effects = effects
        self._gl = _create_context()
        self._gl.enable(moderngl.DEPTH_TEST)
        self._programs = Programs(self._gl, effects)
        self._full_screen = {
            name: self._gl.vertex_array(self._programs[name], []) for name in ("sky", "resolve")
        }
        self._bank = texture_bank()
        self._textures = upload_textures(self._gl, self._bank.pixels)
        self._textures.use(_TEXTURES)
        self._programs.bind_textures(textures=_TEXTURES, samples=_SAMPLES)
        self._materials = MaterialBlock(self._gl)
        self._light_maps = LightMaps(self._gl, self._programs)
        self._geometry: Geometry | None = None
        self._last_frame_buffers: FrameBuffers | None = None
        self._lit_world: World | None = None

    @property
    def name(self) -> str:
        """Name of the OpenGL driver, and the OpenGL version."""
        return f"{self._gl.info['GL_RENDERER']}, OpenGL {self._gl.info['GL_VERSION']}"

    def depth_m(self, world: World, rig: PosedRig, position: float) -> Float[np.ndarray, "h w"]:
        """Return the depth in metres along the optical axis, float32 [H, W]; infinite for the sky."""
        with self._gl:
            geometry = self._upload(world)
            triangles = triangles_in_view(geometry.corners_m, rig, (position,))
            return self._render_depth(geometry, triangles, rig, position)[0]

    def render_views(self, world: World, rig: PosedRig, positions: Sequence[float]) -> list[RenderedView]:
        """Render an image with its ground truth at each position."""
        with self._gl:
            geometry = self._upload(world)
            self._set_light(world, geometry)
            triangles = triangles_in_view(geometry.corners_m, rig, positions)
            return [self._render_view(geometry, triangles, rig, position) for position in positions]

    def close(self) -> None:
        """Release the OpenGL context and its memory; the renderer cannot be used afterwards."""
        self._gl.release()

    def _render_view(
        self, geometry: Geometry, triangles: Int[np.ndarray, " k"], rig: PosedRig, position: float
    ) -> RenderedView:
        depth_m, target = self._render_depth(geometry, triangles, rig, position)
        return RenderedView(
            image=self._render_image(geometry, triangles, rig, position), depth_m=depth_m, target=target
        )

    def _render_depth(
        self, geometry: Geometry, triangles: Int[np.ndarray, " k"], rig: PosedRig, position: float
    ) -> tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
        """Render the depth in metres and the target mask."""
        frame = self._frame_buffers(rig).depth
        frame.use()
        frame.clear(red=np.inf)
        self._set_view("depth", rig, position)
        geometry.draw(self._programs["depth"], triangles)
        values = np.frombuffer(frame.read(components=2, dtype="f4"), np.float32)
        depth_m, target = np.moveaxis(values.reshape(*rig.size_px[::-1], 2), -1, 0)
        return np.ascontiguousarray(depth_m), target > 0.5

    def _render_image(
        self, geometry: Geometry, triangles: Int[np.ndarray, " k"], rig: PosedRig, position: float
    ) -> UInt8[np.ndarray, "h w 3"]:
        frames = self._frame_buffers(rig)
        frames.samples.use()
        frames.samples.clear()
        name = surface_program(len(geometry.world.lamps), any(geometry.world.sky.sun_light))
        self._set_view(name, rig, position)
        geometry.draw(self._programs[name], triangles)
        # The sky lies at the far plane, whose depth equals the depth buffer's clear value.
        self._gl.depth_func = "<="
        self._programs.set_uniforms("sky", direction_matrix=direction_matrix(rig, self.effects.samples).T)
        self._full_screen["sky"].render(vertices=3)
        self._gl.depth_func = "<"
        frames.pixels.use()
        frames.sampled.use(_SAMPLES)
        self._full_screen["resolve"].render(vertices=3)
        pixels = np.frombuffer(frames.pixels.read(components=3), np.uint8)
        return pixels.reshape(*rig.size_px[::-1], 3)

    def _set_view(self, program: str, rig: PosedRig, position: float) -> None:
        self._programs.set_uniforms(
            program, projection=projection(rig).T, axes=rig.axes.T, eye_m=rig.eye_m(position)
        )

    def _frame_buffers(self, rig: PosedRig) -> FrameBuffers:
        """Return frame buffers for the rig's image size; those for the most recent size are cached."""
        if self._last_frame_buffers is None or self._last_frame_buffers.size_px != rig.size_px:
            if self._last_frame_buffers is not None:
                self._last_frame_buffers.release()
            self._last_frame_buffers = FrameBuffers(self._gl, rig.size_px, self.effects.samples)
        return self._last_frame_buffers

    def _upload(self, world: World) -> Geometry:
        """Return the world's triangles in GPU memory; those of the most recent world are cached."""
        if self._geometry is None or self._geometry.world is not world:
            fresh = Geometry(self._gl, world)
            if self._geometry is not None:
                self._geometry.release()
            self._geometry = fresh
        return self._geometry

    def _set_light(self, world: World, geometry: Geometry) -> None:
        """Upload the materials and the lighting that all images of a world share."""
        if world is self._lit_world:
            return
        self._materials.write(world, self._bank)
        sky, fog = world.sky, world.fog
        shared: dict[str, Any] = {
            name: getattr(sky, name) for name in ("sun", "sun_light", "zenith", "horizon", "ground")
        }
        shared["exposure"] = world.exposure
        shared["fog"] = (*fog.colour, fog.density_per_m) if fog else (0.0,) * 4
        layer = self._bank.layer("sky", sky.cloud_variant)
        self._programs.set_uniforms("sky", **shared, cloud_layer=layer, clouds=sky.clouds)
        shared["lamp_m"] = [lamp.position_m for lamp in world.lamps]
        shared["lamp_light"] = [lamp.light for lamp in world.lamps]
        if self.effects.shadows:
            shared |= self._light_maps.render_shadow_map(geometry, sky)
        if self.effects.ambient_occlusion:
            shared |= self._light_maps.write_occlusion(geometry)
        self._programs.set_uniforms(surface_program(len(world.lamps), any(sky.sun_light)), **shared)
        self._lit_world = world


def _create_context() -> moderngl.Context:
    # The type stub of create_context declares its keywords wrongly.
    options: dict[str, Any] = {"standalone": True, "backend": "egl"}
    try:
        return moderngl.create_context(**options)
    except Exception as error:  # glcontext and moderngl have no exception class for this
        raise StereoweaveError(
            f"OpenGL: EGL did not start ({error}); on Debian, run apt install libegl1 libgl1-mesa-dri"
        ) from error
