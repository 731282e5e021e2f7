import pytest

from experiments.handheld.pairs import Original
from stereoweave.learn.data.collage import paint_collage
from stereoweave.stereo import StereoPair


@pytest.fixture(scope="module")
def original():
    painted = paint_collage(77, 0, 2, 480, 640)
    return Original(
        name="collage",
        pair=StereoPair(left=painted.left, right=painted.right),
        truth_px=painted.disparity_px,
        focal_px=640.0,
    )
