"""Shader programs of the OpenGL renderer, built from the files in shaders/."""

from importlib import resources
from typing import Any

import moderngl
import numpy as np

from stereoweave.synth.rendering.effects import Effects
from stereoweave.synth.rendering.shadow_and_occlusion import CELLS

MOST_MATERIALS = 64
MOST_LAMPS = 4

# The vertex shader of each program, followed by the parts of its fragment shader.
_PARTS = {
    "depth": ("depth.vert", "depth.frag"),
    "sun": ("sun.vert", "sun.frag"),
    "sky": ("full_screen.vert", "light.glsl", "sky.frag"),
    "resolve": ("full_screen.vert", "resolve.frag"),
}
_SURFACE = ("surface.vert", "light.glsl", "surface.frag")


class Programs:
    """Shader programs by name, compiled for the active effects.

    Each number of lamps has its own surface program, because llvmpipe takes a quarter longer for a loop whose
    count is a uniform, even if the count is 0. Each of these programs has a variant without the sun, because
    closed rooms need neither sun shadows nor highlights from the sun.
    """

    def __init__(self, gl: moderngl.Context, effects: Effects) -> None:
        def program(vertices: str, *fragments: str, lamps: int = 0, sun: bool = True) -> moderngl.Program:
            defined = _definitions(effects, lamps, sun)
            return gl.program(
                vertex_shader=defined + _read_shader(vertices),
                fragment_shader=defined + "".join(map(_read_shader, fragments)),
            )

        self._programs = {name: program(*parts) for name, parts in _PARTS.items()}
        for lamps in range(MOST_LAMPS + 1):
            for sun in (False, True):
                self._programs[surface_program(lamps, sun)] = program(*_SURFACE, lamps=lamps, sun=sun)

    def __getitem__(self, name: str) -> moderngl.Program:
        return self._programs[name]

    def bind_textures(self, **units: int) -> None:
        """Assign texture units to the samplers of all programs."""
        for program in self._programs.values():
            for key, unit in units.items():
                if key in program:
                    program[key] = unit

    def set_uniforms(self, name: str, **values: Any) -> None:
        """Set a program's uniforms. Matrices are given column by column; unused uniforms are ignored."""
        program = self._programs[name]
        for key, value in values.items():
            uniform = program.get(key, None)
            if isinstance(uniform, moderngl.Uniform):
                uniform.write(np.ascontiguousarray(value, np.float32).tobytes())


def surface_program(lamps: int, sun: bool) -> str:
    """Return the name of the surface program for a number of lamps, with or without the sun."""
    return f"surface, {lamps} lamps{', sun' * sun}"


def _definitions(effects: Effects, lamps: int, sun: bool) -> str:
    switches = ("shadows",) * sun + ("ambient_occlusion", "gloss", "fog", "relief")
    numbers = {"MATERIALS": MOST_MATERIALS, "LAMPS": lamps, "SAMPLES": effects.samples, "CELLS": CELLS}
    lines = [f"#define {name.upper()}" for name in switches if getattr(effects, name)]
    lines += ["#define SUN"] * sun
    lines += [f"#define {name} {number}" for name, number in numbers.items()]
    return "\n".join(["#version 330 core", *lines, ""])


def _read_shader(name: str) -> str:
    return (resources.files("stereoweave.synth.rendering") / "shaders" / name).read_text()
