"""Scene description: triangles, materials, sky, lamps and fog. Lengths are in metres; z points up."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

Colour = tuple[float, float, float]  # linear RGB; 1 is a white surface in sunlight


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """Triangles that share no vertices, so neighbours may differ in normals and texture coordinates.

    Attributes:
        corners_m: float32 [N, 3, 3], indexed by triangle, corner and axis; counter-clockwise from outside.
        normals: float32 [N, 3, 3], outward unit vectors.
        uv_m: float32 [N, 3, 2], texture coordinates in metres along the surface.
        material: int32 [N], index into the world's materials.
        target: bool [N], whether the triangle belongs to the scene's subject.
    """

    corners_m: Float[np.ndarray, "n 3 3"]
    normals: Float[np.ndarray, "n 3 3"]
    uv_m: Float[np.ndarray, "n 3 2"]
    material: Int[np.ndarray, " n"]
    target: Bool[np.ndarray, " n"]

    def transform(self, pose: Float[np.ndarray, "4 4"]) -> "Mesh":
        """Return the mesh transformed by an affine pose; its texture coordinates stay unchanged."""
        # One large product, because many small products are slow in NumPy.
        corners_m = self.corners_m.reshape(-1, 3) @ pose[:3, :3].T.astype(np.float32)
        normals = self.normals.reshape(-1, 3) @ np.linalg.inv(pose[:3, :3]).astype(np.float32)
        normals /= np.sqrt(np.einsum("ij,ij->i", normals, normals))[:, None]
        return replace(
            self,
            corners_m=(corners_m + pose[:3, 3].astype(np.float32)).reshape(-1, 3, 3),
            normals=normals.reshape(-1, 3, 3),
        )

    def translate(self, x: float = 0, y: float = 0, z: float = 0) -> "Mesh":
        """Return the mesh translated by x, y and z in metres."""
        return replace(self, corners_m=self.corners_m + np.array([x, y, z], np.float32))

    def as_target(self) -> "Mesh":
        """Return the mesh with all its triangles marked as the scene's subject."""
        return replace(self, target=np.ones_like(self.target))


def join_meshes(meshes: Iterable[Mesh]) -> Mesh:
    """Join several meshes into one."""
    parts = list(meshes)
    names = ("corners_m", "normals", "uv_m", "material", "target")
    return Mesh(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


@dataclass(frozen=True, kw_only=True)
class Material:
    """Appearance of a surface.

    Attributes:
        texture: A family of the texture bank (textures.bank.FAMILIES), such as "rust".
        variant: Index of the texture in its family, taken modulo the family's size.
        tint: Factor that multiplies the texture's colour.
        span_m: Period of the texture in metres.
        roughness: From 0 (like a mirror) to 1 (like chalk).
        metal: 0 for paint, stone and cloth; 1 for bare metal.
        relief: Strength of the bump map, from 0 to 1.
        glow: Emitted light, as a multiple of the colour.
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
    """The sky, the sun and their light.

    Attributes:
        sun: Unit vector towards the sun.
        sun_light: The sun's colour and strength; (0, 0, 0) indoors.
        zenith, horizon, ground: Colours of the visible sky's gradient; they also light surfaces from above,
            from the side and from below.
        cloud_variant: Index of the cloud texture in the family "sky".
        clouds: Cloud cover, from 0 (clear) to 1 (overcast).
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
    """A point light that casts no shadows; its light falls off with the square of the distance.

    Attributes:
        position_m: Position in the world.
        light: Colour and strength at 1 m.
    """

    position_m: tuple[float, float, float]
    light: Colour


@dataclass(frozen=True, kw_only=True)
class Fog:
    """Haze: at distance d, a surface keeps the fraction exp(-density_per_m * d) of its colour."""

    colour: Colour
    density_per_m: float


@dataclass(frozen=True, kw_only=True)
class World:
    """Everything that a renderer needs except the camera.

    Attributes:
        mesh: All triangles.
        materials: At most 64; `mesh.material` is an index into them.
        lamps: At most 4.
        exposure: Factor that multiplies colours before tone mapping.
    """

    mesh: Mesh
    materials: tuple[Material, ...]
    sky: Sky
    lamps: tuple[Lamp, ...] = ()
    fog: Fog | None = None
    exposure: float = 1.0


@dataclass(frozen=True, kw_only=True)
class RenderedView:
    """An image of a world with its ground truth.

    Attributes:
        image: uint8 RGB [H, W, 3].
        depth_m: Depth along the optical axis at pixel centres, float32 [H, W]; infinite for the sky.
        target: bool [H, W], whether the pixel centre shows the scene's subject.
    """

    image: UInt8[np.ndarray, "h w 3"]
    depth_m: Float[np.ndarray, "h w"]
    target: Bool[np.ndarray, "h w"]
