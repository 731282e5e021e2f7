"""Rendering effects, each of which can be turned off."""

from dataclasses import dataclass

from stereoweave.errors import StereoweaveError


@dataclass(frozen=True, kw_only=True)
class Effects:
    """Switches of the effects; `synth costs` measures the time of each.

    Attributes:
        shadows: of the sun.
        ambient_occlusion: less light from the sky in corners and narrow places.
        gloss: highlights of sun and lamps, reflections of the sky.
        fog: haze.
        relief: bump mapping by the texture's height.
        samples: 2 for 2x2 samples per pixel, 1 for the centre only.
    """

    shadows: bool = True
    ambient_occlusion: bool = True
    gloss: bool = True
    fog: bool = True
    relief: bool = True
    samples: int = 2

    def __post_init__(self) -> None:
        if self.samples not in (1, 2):
            raise StereoweaveError(f"samples: expected 1 or 2, found {self.samples}")


PLAIN = Effects(shadows=False, ambient_occlusion=False, gloss=False, fog=False, relief=False, samples=1)
