"""The renderer's programs for the graphics card, from the files in shaders/."""

from importlib import resources
from typing import Any

import moderngl
import numpy as np

from stereoweave.synth.effects import Effects
from stereoweave.synth.lighting import CELLS

MOST_MATERIALS = 64
MOST_LAMPS = 4

# Vertex shader, then what the fragment shader is joined from.
_PARTS = {
    "depth": ("depth.vert", "depth.frag"),
    "sun": ("sun.vert", "sun.frag"),
    "surface": ("surface.vert", "light.glsl", "surface.frag"),
    "sky": ("whole.vert", "light.glsl", "sky.frag"),
    "resolve": ("whole.vert", "resolve.frag"),
}


class Programs:
    """Every program by its name, compiled with the effects that are switched on."""

    def __init__(self, gl: moderngl.Context, effects: Effects) -> None:
        defined = _definitions(effects)
        self._programs = {
            name: gl.program(
                vertex_shader=defined + _text(vertices),
                fragment_shader=defined + "".join(map(_text, fragments)),
            )
            for name, (vertices, *fragments) in _PARTS.items()
        }

    def __getitem__(self, name: str) -> moderngl.Program:
        return self._programs[name]

    def set(self, name: str, **values: Any) -> None:
        """Sets a program's uniforms, matrices by columns; those that no effect uses are passed over."""
        for key, value in values.items():
            uniform = self._programs[name].get(key, None)
            if isinstance(uniform, moderngl.Uniform):
                kind = np.int32 if np.asarray(value).dtype.kind == "i" else np.float32
                uniform.write(np.ascontiguousarray(value, kind).tobytes())


def _definitions(effects: Effects) -> str:
    switches = ("shadows", "ambient_occlusion", "gloss", "fog", "relief")
    numbers = {"MATERIALS": MOST_MATERIALS, "LAMPS": MOST_LAMPS, "SAMPLES": effects.samples, "CELLS": CELLS}
    lines = [f"#define {name.upper()}" for name in switches if getattr(effects, name)]
    lines += [f"#define {name} {number}" for name, number in numbers.items()]
    return "\n".join(["#version 330 core", *lines, ""])


def _text(name: str) -> str:
    return (resources.files("stereoweave.synth") / "shaders" / name).read_text()
