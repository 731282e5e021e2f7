"""Which camera takes the pictures: OpenGL where it works, else ray casting."""

import warnings

from stereoweave.errors import StereoweaveError
from stereoweave.synth.rendering.effects import Effects
from stereoweave.synth.sets.pair_rendering import Camera

_PACKAGES = "on Debian: apt install libegl1 libgl1-mesa-dri"


def camera_for(effects: Effects) -> Camera:
    """A `Renderer`; where OpenGL does not start a `Raycaster`, and a warning that says so."""
    try:
        from stereoweave.synth.rendering.opengl import Renderer

        return Renderer(effects)
    except (ImportError, StereoweaveError) as error:
        without_opengl = error
    try:
        from stereoweave.synth.rendering.raycast import Raycaster
    except ImportError as error:
        raise StereoweaveError(
            f"rendering: expected OpenGL (EGL) or embree, found neither ({without_opengl}; {error}); "
            f"pip install 'stereoweave[synth]', and {_PACKAGES}"
        ) from error
    warnings.warn(
        f"rendering by embree, which is slower and plainer, because: {without_opengl}",
        stacklevel=2,
    )
    return Raycaster(effects)
