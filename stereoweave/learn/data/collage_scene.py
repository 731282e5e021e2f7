"""Parts of a collage: layers of painted surfaces within silhouettes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from stereoweave.learn.data.paint_kernels import Paint, Sheet, sum_surface
from stereoweave.learn.data.silhouettes import Patch


@dataclass(frozen=True, kw_only=True)
class CollageSurface:
    """Disparity as a function of x and y in the left image: the sum of a plane, waves and hills.

    Attributes:
        plane: Disparity at the centre, its slopes along x and y, and the centre's x and y.
        waves: Amplitude in px, angular frequencies along x and y, and phase of each wave.
        hills: Height in px, centre x and y, and inverse radii along x and y of each hill. An inverse radius
            of 0 gives a ridge, as on a cylinder.
        limit_px: Largest disparity of the scene; the sum is clamped to 0..limit_px.
    """

    plane: tuple[float, float, float, float, float]
    waves: tuple[tuple[float, float, float, float], ...] = ()
    hills: tuple[tuple[float, float, float, float, float], ...] = ()
    limit_px: float

    def plane_px(self, x: float, y: float) -> float:
        """Return the disparity at a point, without waves and hills."""
        level, slope_x, slope_y, centre_x, centre_y = self.plane
        return min(max(level + slope_x * (x - centre_x) + slope_y * (y - centre_y), 0.0), self.limit_px)

    def over(self, patch: Patch) -> Float[np.ndarray, "h w"]:
        """Return the disparity at each pixel of the patch as float32."""
        x = np.arange(patch.field.shape[1], dtype=np.float32) + patch.left
        y = np.arange(patch.field.shape[0], dtype=np.float32) + patch.top
        level, slope_x, slope_y, centre_x, centre_y = self.plane
        columns = [level + slope_x * (x - centre_x), np.ones_like(x)]
        rows = [np.ones_like(y), slope_y * (y - centre_y)]
        for amplitude, along_x, along_y, phase in self.waves:
            columns += [amplitude * np.sin(along_x * x + phase), amplitude * np.cos(along_x * x + phase)]
            rows += [np.cos(along_y * y), np.sin(along_y * y)]
        for height, middle_x, middle_y, inverse_x, inverse_y in self.hills:
            columns.append(height * np.exp(-(((x - middle_x) * inverse_x) ** 2)))
            rows.append(np.exp(-(((y - middle_y) * inverse_y) ** 2)))
        return sum_surface(
            np.stack(columns).astype(np.float32), np.stack(rows).astype(np.float32), self.limit_px
        )


@dataclass(frozen=True, kw_only=True)
class CollageLayer:
    """A painted surface within a silhouette."""

    patch: Patch
    surface: CollageSurface
    paint: Paint

    def sheet(self) -> Sheet:
        """Return the layer as the left camera sees it."""
        return Sheet(self.patch.field, self.surface.over(self.patch), self.patch.left, self.patch.top)


@dataclass(frozen=True, kw_only=True)
class CollageScene:
    """Layers sorted from far to near by their centres, and the size of the views in px."""

    layers: tuple[CollageLayer, ...]
    height: int
    width: int
