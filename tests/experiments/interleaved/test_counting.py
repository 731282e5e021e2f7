import cv2
import numpy as np

from experiments.interleaved.counting import SuspectedRow, count_suspected, make_pictures


def test_views_alternate_from_the_left_one_on():
    left, right = (np.full((2, 3, 3), level, np.uint8) for level in (1, 2))
    pictures = {name: image[..., 0].tolist() for name, image in make_pictures(left, right)}
    assert pictures["row_interleaved"] == [[1, 1, 1], [2, 2, 2]]
    assert pictures["column_interleaved"] == [[1, 2, 1], [1, 2, 1]]
    assert pictures["checkerboard"] == [[1, 2, 1], [2, 1, 2]]


def test_a_pair_has_two_ordinary_pictures_and_one_in_each_layout(tmp_path):
    scene = tmp_path / "grey"
    scene.mkdir()
    for name in ("left", "right"):
        cv2.imwrite(str(scene / f"{name}.png"), np.full((128, 160, 3), 90, np.uint8))
    cv2.imwrite(str(scene / "disparity.png"), np.full((128, 160), 256, np.uint16))
    rows = count_suspected(tmp_path)
    assert [(row.layout, row.stored, row.pictures) for row in rows] == [
        (layout, stored, count)
        for layout, count in (
            ("ordinary", 2),
            ("row_interleaved", 1),
            ("column_interleaved", 1),
            ("checkerboard", 1),
        )
        for stored in ("png", "jpeg")
    ]
    # Nothing can be seen to move in plain pictures.
    assert rows[0] == SuspectedRow(layout="ordinary", stored="png", pictures=2, suspected=0, named_rightly=2)
    assert all(row.suspected == row.named_rightly == 0 for row in rows[2:])
