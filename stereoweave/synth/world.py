"""What a scene is made of: triangles, materials, sky, lamps, fog. Metres; z is up."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

Colour = tuple[float, float, float]  # RGB, linear, 1 is as bright as a white sheet in the sun


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """Triangles, each with corners of its own, so that neighbours may differ in normal and texture.

    Attributes:
        corners_m: float32 [N, 3, 3]: triangle, corner, x y z; counter-clockwise seen from outside.
        normals: float32 [N, 3, 3], of unit length, outwards.
        uv_m: float32 [N, 3, 2], where the texture is looked up, in metres along the surface.
        material: int32 [N], index in the world's materials.
        target: bool [N], whether the triangle belongs to what the scene is named after.
    """

    corners_m: Float[np.ndarray, "n 3 3"]
    normals: Float[np.ndarray, "n 3 3"]
    uv_m: Float[np.ndarray, "n 3 2"]
    material: Int[np.ndarray, " n"]
    target: Bool[np.ndarray, " n"]

    def transform(self, pose: Float[np.ndarray, "4 4"]) -> "Mesh":
        """The mesh under a rotation, uniform or not scaling and shift; its texture moves along unscaled."""
        # In one product: NumPy is slow at many small ones.
        corners_m = self.corners_m.reshape(-1, 3) @ pose[:3, :3].T.astype(np.float32)
        normals = self.normals.reshape(-1, 3) @ np.linalg.inv(pose[:3, :3]).astype(np.float32)
        normals /= np.sqrt(np.einsum("ij,ij->i", normals, normals))[:, None]
        return replace(
            self,
            corners_m=(corners_m + pose[:3, 3].astype(np.float32)).reshape(-1, 3, 3),
            normals=normals.reshape(-1, 3, 3),
        )

    def translate(self, x: float = 0, y: float = 0, z: float = 0) -> "Mesh":
        """The mesh, shifted in metres."""
        return replace(self, corners_m=self.corners_m + np.array([x, y, z], np.float32))

    def as_target(self) -> "Mesh":
        """The mesh as part of what the scene is named after."""
        return replace(self, target=np.ones_like(self.target))


def join_meshes(meshes: Iterable[Mesh]) -> Mesh:
    """All triangles in one mesh."""
    parts = list(meshes)
    names = ("corners_m", "normals", "uv_m", "material", "target")
    return Mesh(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


@dataclass(frozen=True, kw_only=True)
class Material:
    """How a surface looks.

    Attributes:
        texture: a family of the texture bank (textures.FAMILIES), such as "rust".
        variant: which texture of the family, counted on past its end.
        tint: multiplies the texture's colour.
        span_m: how many metres the texture spans before it repeats.
        roughness: 0 is a mirror, 1 is chalk.
        metal: 0 for paint, stone, cloth; 1 for bare metal.
        relief: 0 to 1, how strongly the texture's height bends the normal.
        glow: light given off, as a multiple of the colour.
    """

    texture: str
    variant: int = 0
    tint: Colour = (1.0, 1.0, 1.0)
    span_m: float = 2.0
    roughness: float = 0.8
    metal: float = 0.0
    relief: float = 0.3
    glow: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Sky:
    """Sky, sun and the light that both give.

    Attributes:
        sun: unit vector towards the sun.
        sun_light: its colour and strength; (0, 0, 0) under an overcast sky or indoors.
        zenith, horizon, ground: colours that surfaces are lit with, and that are seen, from above, from the
            side and from below.
        cloud_variant: which texture of the family "sky" lies over the gradient.
        clouds: 0 for a clear sky to 1 for a covered one.
    """

    sun: tuple[float, float, float]
    sun_light: Colour
    zenith: Colour
    horizon: Colour
    ground: Colour
    cloud_variant: int = 0
    clouds: float = 0.5


@dataclass(frozen=True, kw_only=True)
class Lamp:
    """A lamp that shines to all sides without a shadow; its light falls with the square of the distance.

    light is its colour and strength at 1 m.
    """

    position_m: tuple[float, float, float]
    light: Colour


@dataclass(frozen=True, kw_only=True)
class Fog:
    """Haze: what is at distance d keeps exp(-density_per_m * d) of its colour."""

    colour: Colour
    density_per_m: float


@dataclass(frozen=True, kw_only=True)
class World:
    """Everything that a renderer needs but the camera.

    Attributes:
        mesh: all triangles.
        materials: what `mesh.material` counts; at most 64.
        lamps: at most 4.
        exposure: what colours are multiplied with before the tone curve.
    """

    mesh: Mesh
    materials: tuple[Material, ...]
    sky: Sky
    lamps: tuple[Lamp, ...] = ()
    fog: Fog | None = None
    exposure: float = 1.0


@dataclass(frozen=True, kw_only=True)
class RenderedView:
    """A picture of a world with its truth.

    Attributes:
        image: uint8 RGB [H, W, 3].
        depth_m: float32 [H, W], along the optical axis through the pixels' centres; infinite for the sky.
        target: bool [H, W], whether the pixel's centre shows what the scene is named after.
    """

    image: UInt8[np.ndarray, "h w 3"]
    depth_m: Float[np.ndarray, "h w"]
    target: Bool[np.ndarray, "h w"]
