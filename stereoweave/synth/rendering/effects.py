"""What may be switched off in a picture for speed, or to see what it does."""

from dataclasses import dataclass

from stereoweave.errors import StereoweaveError


@dataclass(frozen=True, kw_only=True)
class Effects:
    """What makes a picture look real; each costs time (costs.py measures how much).

    Attributes:
        shadows: of the sun.
        ambient_occlusion: corners and crowded places get less light from the sky.
        gloss: highlights of sun and lamps, reflections of the sky.
        fog: haze over the distance.
        relief: the texture's height bends the normals.
        samples: 2 takes 2x2 samples a pixel, 1 takes its centre alone.
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
