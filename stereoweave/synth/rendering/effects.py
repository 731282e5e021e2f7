"""Rendering effects, each of which can be turned off."""

from dataclasses import dataclass

from stereoweave.errors import StereoweaveError


@dataclass(frozen=True, kw_only=True)
class Effects:
    """Switches for the rendering effects; `synth costs` measures the time that each one takes.

    Attributes:
        shadows: Shadows cast by the sun.
        ambient_occlusion: Dimmer skylight in corners and narrow gaps.
        gloss: Highlights from the sun and lamps, and reflections of the sky.
        fog: Haze that grows with distance.
        relief: Bump mapping from the texture's height map.
        samples: 2 for 2x2 samples per pixel, 1 for a single sample at the pixel's centre.
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
