"""Choice of renderer: OpenGL if it works, otherwise ray casting."""

import warnings
from functools import cache

from stereoweave.errors import StereoweaveError
from stereoweave.synth.rendering.effects import PLAIN, Effects
from stereoweave.synth.sets.pair_rendering import SceneRenderer

_PACKAGES = "on Debian, apt install libegl1 libgl1-mesa-dri"


@cache
def shared_renderer(plain: bool = False) -> SceneRenderer:
    """Return the best renderer that starts, shared within this process; `plain` turns all effects off."""
    return choose_renderer(PLAIN if plain else Effects())


def choose_renderer(effects: Effects) -> SceneRenderer:
    """Return an `OpenGLRenderer`, or warn and return a `Raycaster` if OpenGL does not start."""
    try:
        from stereoweave.synth.rendering.opengl import OpenGLRenderer

        return OpenGLRenderer(effects)
    except (ImportError, StereoweaveError) as error:
        without_opengl = error
    try:
        from stereoweave.synth.rendering.raycast import Raycaster
    except ImportError as error:
        raise StereoweaveError(
            f"rendering: expected OpenGL (EGL) or embree, found neither ({without_opengl}; {error}); "
            f'run pip install "stereoweave[synth]", and {_PACKAGES}'
        ) from error
    warnings.warn(
        f"rendering with embree, which is slower and plainer, because OpenGL did not start: {without_opengl}",
        stacklevel=2,
    )
    return Raycaster(effects)
