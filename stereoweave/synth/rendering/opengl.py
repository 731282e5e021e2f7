"""Pictures and exact depth of a world by OpenGL, without a window; Mesa needs no graphics card."""

from collections.abc import Sequence
from typing import Any

import moderngl
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from stereoweave.errors import StereoweaveError
from stereoweave.synth.rendering.effects import Effects
from stereoweave.synth.rendering.frustum import in_view, projection, to_direction
from stereoweave.synth.rendering.gpu_buffers import Frames, Geometry, MaterialBlock, texture_array
from stereoweave.synth.rendering.light_maps import LightMaps
from stereoweave.synth.rendering.shader_programs import Programs, surface
from stereoweave.synth.textures.bank import bank
from stereoweave.synth.viewpoints import Rig
from stereoweave.synth.world import Shot, World

_TEXTURES, _SAMPLES = 0, 1  # texture units


class Renderer:
    """Takes pictures of worlds; a `synth.samples.Camera`.

    A world and a rig give the same bytes, whatever was rendered before. Depth is rasterised apart from the
    picture, through the pixels' centres. The picture takes 2x2 samples a pixel, their mean position its
    centre, and shades each of them: under llvmpipe that takes little more than half the time of
    multisampling, which shades what is hidden too, and it smooths highlights and shadows' edges as well.
    """

    def __init__(self, effects: Effects = Effects()) -> None:  # noqa: B008, frozen
        self.effects = effects
        self._gl = _context()
        self._gl.enable(moderngl.DEPTH_TEST)
        self._programs = Programs(self._gl, effects)
        self._whole = {name: self._gl.vertex_array(self._programs[name], []) for name in ("sky", "resolve")}
        self._bank = bank()
        self._textures = texture_array(self._gl, self._bank.pixels)
        self._textures.use(_TEXTURES)
        self._programs.bind(textures=_TEXTURES, samples=_SAMPLES)
        self._materials = MaterialBlock(self._gl)
        self._light_maps = LightMaps(self._gl, self._programs)
        self._geometry: Geometry | None = None
        self._frames: Frames | None = None
        self._lit: World | None = None

    @property
    def name(self) -> str:
        """Which OpenGL draws, and of what version."""
        return f"{self._gl.info['GL_RENDERER']}, OpenGL {self._gl.info['GL_VERSION']}"

    def depth_m(self, world: World, rig: Rig, position: float) -> Float[np.ndarray, "h w"]:
        """float32 [H, W] in metres along the optical axis; infinite where nothing is."""
        with self._gl:
            geometry = self._uploaded(world)
            triangles = in_view(geometry.corners_m, rig, (position,))
            return self._truth(geometry, triangles, rig, position)[0]

    def shots(self, world: World, rig: Rig, positions: Sequence[float]) -> list[Shot]:
        """A picture with its truth for each position."""
        with self._gl:
            geometry = self._uploaded(world)
            self._light(world, geometry)
            triangles = in_view(geometry.corners_m, rig, positions)
            return [self._shot(geometry, triangles, rig, position) for position in positions]

    def close(self) -> None:
        """Gives back all memory; the renderer is of no use afterwards."""
        self._gl.release()

    def _shot(self, geometry: Geometry, triangles: Int[np.ndarray, " k"], rig: Rig, position: float) -> Shot:
        depth_m, target = self._truth(geometry, triangles, rig, position)
        return Shot(image=self._image(geometry, triangles, rig, position), depth_m=depth_m, target=target)

    def _truth(
        self, geometry: Geometry, triangles: Int[np.ndarray, " k"], rig: Rig, position: float
    ) -> tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
        """Depth, and whether it is the target's."""
        frame = self._framed(rig).depth
        frame.use()
        frame.clear(red=np.inf)
        self._aim("depth", rig, position)
        geometry.draw(self._programs["depth"], triangles)
        values = np.frombuffer(frame.read(components=2, dtype="f4"), np.float32)
        depth_m, target = np.moveaxis(values.reshape(*rig.size_px[::-1], 2), -1, 0)
        return np.ascontiguousarray(depth_m), target > 0.5

    def _image(
        self, geometry: Geometry, triangles: Int[np.ndarray, " k"], rig: Rig, position: float
    ) -> UInt8[np.ndarray, "h w 3"]:
        frames = self._framed(rig)
        frames.samples.use()
        frames.samples.clear()
        name = surface(len(geometry.world.lamps), any(geometry.world.sky.sun_light))
        self._aim(name, rig, position)
        geometry.draw(self._programs[name], triangles)
        # The sky lies at the far end of the depth buffer, which is what it was cleared to.
        self._gl.depth_func = "<="
        self._programs.set("sky", to_direction=to_direction(rig, self.effects.samples).T)
        self._whole["sky"].render(vertices=3)
        self._gl.depth_func = "<"
        frames.pixels.use()
        frames.sampled.use(_SAMPLES)
        self._whole["resolve"].render(vertices=3)
        pixels = np.frombuffer(frames.pixels.read(components=3), np.uint8)
        return pixels.reshape(*rig.size_px[::-1], 3)

    def _aim(self, program: str, rig: Rig, position: float) -> None:
        self._programs.set(program, projection=projection(rig).T, axes=rig.axes.T, eye_m=rig.eye_m(position))

    def _framed(self, rig: Rig) -> Frames:
        """Frame buffers of the rig's size; those of the last size are kept."""
        if self._frames is None or self._frames.size_px != rig.size_px:
            if self._frames is not None:
                self._frames.release()
            self._frames = Frames(self._gl, rig.size_px, self.effects.samples)
        return self._frames

    def _uploaded(self, world: World) -> Geometry:
        """The world's triangles; those of the last world are kept."""
        if self._geometry is None or self._geometry.world is not world:
            fresh = Geometry(self._gl, world)
            if self._geometry is not None:
                self._geometry.release()
            self._geometry = fresh
        return self._geometry

    def _light(self, world: World, geometry: Geometry) -> None:
        """Everything about materials and light that pictures of one world share."""
        if world is self._lit:
            return
        self._materials.write(world, self._bank)
        sky, fog = world.sky, world.fog
        shared: dict[str, Any] = {
            name: getattr(sky, name) for name in ("sun", "sun_light", "zenith", "horizon", "ground")
        }
        shared["exposure"] = world.exposure
        shared["fog"] = (*fog.colour, fog.density_per_m) if fog else (0.0,) * 4
        layer = self._bank.layer("sky", sky.cloud_variant)
        self._programs.set("sky", **shared, cloud_layer=layer, clouds=sky.clouds)
        shared["lamp_m"] = [lamp.position_m for lamp in world.lamps]
        shared["lamp_light"] = [lamp.light for lamp in world.lamps]
        if self.effects.shadows:
            shared |= self._light_maps.cast(geometry, sky)
        if self.effects.ambient_occlusion:
            shared |= self._light_maps.occlude(geometry)
        self._programs.set(surface(len(world.lamps), any(sky.sun_light)), **shared)
        self._lit = world


def _context() -> moderngl.Context:
    # The stub of create_context takes keywords for a dictionary.
    options: dict[str, Any] = {"standalone": True, "backend": "egl"}
    try:
        return moderngl.create_context(**options)
    except Exception as error:  # glcontext and moderngl raise no class of their own for this
        raise StereoweaveError(
            f"OpenGL: expected EGL to start, found {error}; on Debian: apt install libegl1 libgl1-mesa-dri"
        ) from error
