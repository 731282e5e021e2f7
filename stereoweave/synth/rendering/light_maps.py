"""Textures for a world's lighting: the sun's shadow map and the ambient occlusion grid."""

from typing import Any

import moderngl
import numpy as np
from jaxtyping import Float

from stereoweave.synth.rendering.gpu_buffers import Geometry
from stereoweave.synth.rendering.shader_programs import Programs
from stereoweave.synth.rendering.shadow_and_occlusion import CELLS, SunView, count_occlusion, fit_sun_view
from stereoweave.synth.world import Sky

# The shadow map holds two cascades side by side: a square around the target and a wider one. At 640x480 their
# texels are already as small as the samples.
_INNER_PX, _WIDE_PX = 1536, 1024
_REACH_M = 40.0
_SHADOW_MAP, _OCCLUSION = 2, 3  # texture units


class LightMaps:
    """Light textures, rewritten for each world, and the uniforms that shaders need to read them."""

    def __init__(self, gl: moderngl.Context, programs: Programs) -> None:
        self._gl = gl
        self._programs = programs
        self._map = gl.depth_texture((_INNER_PX + _WIDE_PX, _INNER_PX))
        self._map.filter = moderngl.LINEAR, moderngl.LINEAR
        self._map.compare_func = "<="
        self._map.use(_SHADOW_MAP)
        self._frame = gl.framebuffer(depth_attachment=self._map)
        self._occlusion = gl.texture3d((CELLS, CELLS, CELLS), 1)
        self._occlusion.filter = moderngl.LINEAR, moderngl.LINEAR
        self._occlusion.repeat_x = self._occlusion.repeat_y = self._occlusion.repeat_z = False
        self._occlusion.use(_OCCLUSION)
        programs.bind_textures(shadow_map=_SHADOW_MAP, occlusion=_OCCLUSION)

    def render_shadow_map(self, geometry: Geometry, sky: Sky) -> dict[str, Any]:
        """Render the sun's shadow map and return its uniforms; {} if the sun gives no light."""
        self._frame.use()
        self._frame.clear()
        if not any(sky.sun_light):
            return {}
        view = fit_sun_view(geometry.corners_m, geometry.target_m, sky.sun, _REACH_M)
        # Shift depth away from the sun to prevent self-shadowing.
        self._gl.polygon_offset = 2.0, 4.0
        for left_px, side_px, to_unit, triangles in (
            (0, _INNER_PX, view.to_unit, view.inside),
            (_INNER_PX, _WIDE_PX, _widen(view), view.beyond),
        ):
            self._frame.viewport = left_px, 0, side_px, side_px
            self._programs.set_uniforms("sun", to_unit=to_unit.T)
            geometry.draw(self._programs["sun"], triangles)
        self._gl.polygon_offset = 0.0, 0.0
        width_px, height_px = self._map.size
        return {
            "to_unit": view.to_unit.T,
            "inner_m": view.inner_m,
            "wide": view.wide,
            "squares": (
                _INNER_PX / width_px,
                _WIDE_PX / width_px,
                _INNER_PX / height_px,
                _WIDE_PX / height_px,
            ),
            "texels": (1 / _INNER_PX, view.wide / _WIDE_PX),
        }

    def write_occlusion(self, geometry: Geometry) -> dict[str, Any]:
        """Write the ambient occlusion grid and return its uniforms."""
        counted = count_occlusion(geometry.corners_m, geometry.target_m)
        self._occlusion.write(counted.share)
        side_m = counted.cell_m * CELLS
        return {"occlusion_frame": (*counted.low_m, 1 / side_m)}


def _widen(view: SunView) -> Float[np.ndarray, "3 4"]:
    """Return the counterpart of `view.to_unit` for the wide square."""
    scale = np.diag([1 / view.wide, 1 / view.wide, 1])
    middle = np.array([0.5, 0.5, 0])
    wide = scale @ view.to_unit
    wide[:, 3] += middle - scale @ middle
    return wide
