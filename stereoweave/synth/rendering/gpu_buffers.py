"""GPU memory for a world's triangles and materials, for textures, and for frame buffers."""

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import moderngl
import numpy as np
from jaxtyping import Int, UInt8

from stereoweave.errors import StereoweaveError
from stereoweave.synth.rendering.shader_programs import MOST_LAMPS, MOST_MATERIALS
from stereoweave.synth.textures.bank import TextureBank, srgb_to_linear
from stereoweave.synth.world import World

# Relief height of a texture at full strength, as a fraction of its period.
_RELIEF_SHARE = 0.018
_FLOATS = 12  # floats per material in std140 layout, which are three vectors of four


class Geometry:
    """A world's triangles in GPU memory; `release` frees the memory.

    Attributes:
        world: The world that the triangles belong to.
        corners_m: Corners of the triangles, float32 [3, 3, N], indexed by axis, corner and triangle.
        target_m: Corners of the target's triangles, or of all triangles if the world has no target.
    """

    def __init__(self, gl: moderngl.Context, world: World) -> None:
        _check_limits(world)
        self._gl = gl
        self.world = world
        mesh = world.mesh
        self.corners_m = np.ascontiguousarray(mesh.corners_m.T, np.float32)
        self.target_m = self.corners_m[..., mesh.target] if mesh.target.any() else self.corners_m
        tag = np.repeat(mesh.material + MOST_MATERIALS * mesh.target, 3)
        with _reporting_lack_of_memory(f"a world of {len(mesh.material)} triangles"):
            self._attributes = {
                "corner_m": (self._buffer(mesh.corners_m, np.float32), "3f"),
                "normal": (self._buffer(mesh.normals, np.float32), "3f"),
                "uv_m": (self._buffer(mesh.uv_m, np.float32), "2f"),
                "tag": (self._buffer(tag, np.int32), "1i"),
            }

    def draw(self, program: moderngl.Program, triangles: Int[np.ndarray, " k"]) -> None:
        """Draw triangles in the given order."""
        if len(triangles) == 0:
            return
        corners = self._buffer(3 * triangles[:, None] + np.arange(3), np.int32)
        used = [(buffer, form, name) for name, (buffer, form) in self._attributes.items() if name in program]
        array = self._gl.vertex_array(program, used, index_buffer=corners)
        array.render()
        array.release()
        corners.release()

    def release(self) -> None:
        """Free the GPU memory."""
        for buffer, _ in self._attributes.values():
            buffer.release()

    def _buffer(self, values: np.ndarray, kind: type) -> moderngl.Buffer:
        return self._gl.buffer(np.ascontiguousarray(values, kind))


@contextmanager
def _reporting_lack_of_memory(what: str) -> Iterator[None]:
    try:
        yield
    except moderngl.Error as error:
        raise StereoweaveError(
            f"{what}: expected enough OpenGL memory, found too little ({error}); request smaller pictures"
        ) from error


def _check_limits(world: World) -> None:
    for name, most, remedy in (
        ("materials", MOST_MATERIALS, "share materials between parts"),
        ("lamps", MOST_LAMPS, "omit the faintest lamps"),
    ):
        count = len(getattr(world, name))
        if count > most:
            raise StereoweaveError(f"world: expected at most {most} {name}, found {count}; {remedy}")


class MaterialBlock:
    """The shaders' uniform block `Materials`."""

    def __init__(self, gl: moderngl.Context) -> None:
        # Binding 0, because this is the program's only block.
        self._buffer = gl.buffer(reserve=4 * _FLOATS * MOST_MATERIALS)
        self._buffer.bind_to_uniform_block(0)

    def write(self, world: World, textures: TextureBank) -> None:
        """Upload a world's materials."""
        rows = np.zeros((MOST_MATERIALS, _FLOATS), np.float32)
        for row, material in zip(rows, world.materials, strict=False):
            row[:9] = (
                *material.tint,
                material.roughness,
                textures.layer(material.texture, material.variant),
                1 / material.span_m,
                material.metal,
                material.relief * material.span_m * _RELIEF_SHARE,
                material.glow,
            )
        self._buffer.write(rows)


def upload_textures(
    gl: moderngl.Context, pixels: UInt8[np.ndarray, "layers side side 4"]
) -> moderngl.TextureArray:
    """Upload all textures with mipmaps; colours are stored as square roots of linear light.

    Square roots can be stored in bytes, which llvmpipe filters fastest, and the shader restores linear light
    with one multiplication.
    """
    layers, height, width, channels = pixels.shape
    array = gl.texture_array((width, height, layers), channels)
    levels = np.arange(256)
    root = np.round(255 * np.sqrt(srgb_to_linear(levels.astype(np.float32))))
    table = np.stack([root, root, root, levels], -1).astype(np.uint8)[None]
    for k, layer in enumerate(pixels):
        array.write(cv2.LUT(layer, table), viewport=(0, 0, k, width, height, 1))
    array.build_mipmaps()
    array.filter = moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR
    return array


class FrameBuffers:
    """Frame buffers for the depth, samples and pixels of one image size; `release` frees them."""

    def __init__(self, gl: moderngl.Context, size_px: tuple[int, int], samples: int) -> None:
        self.size_px = size_px
        fine = size_px[0] * samples, size_px[1] * samples
        with _reporting_lack_of_memory(f"pictures of {size_px[0]}x{size_px[1]} px"):
            self.sampled = gl.texture(fine, 4)
            self._renderbuffers = [
                gl.renderbuffer(size_px, 2, dtype="f4"),
                gl.depth_renderbuffer(size_px),
                gl.depth_renderbuffer(fine),
                gl.renderbuffer(size_px, 4),
            ]
            places, near, fine_near, shown = self._renderbuffers
            self.depth = gl.framebuffer([places], near)
            self.samples = gl.framebuffer([self.sampled], fine_near)
            self.pixels = gl.framebuffer([shown])

    def release(self) -> None:
        """Free the GPU memory."""
        for frame in (self.depth, self.samples, self.pixels):
            frame.release()
        for buffer in self._renderbuffers:
            buffer.release()
        self.sampled.release()
