import cv2
import numpy as np
import pytest

from stereoweave.cameras.calibration_files import read_rig
from stereoweave.cameras.rig import Optics, Rig
from stereoweave.io.structured_text import parse_entries

KINDS = ["yml", "xml", "json"]
WAYS = [0, cv2.FileStorage_WRITE_BASE64]
# OpenCV does not write 16-bit floats in base64.
TYPES = [np.float64, np.float32, np.float16, np.int32, np.int16, np.uint16, np.int8, np.uint8]


def written(kind, flags=0):
    return cv2.FileStorage(f".{kind}", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY | flags)


def read_by_opencv(text, name):
    storage = cv2.FileStorage(text, cv2.FileStorage_READ | cv2.FileStorage_MEMORY)
    return storage.getNode(name).mat()


def as_numbers(value):
    """Return the value with strings converted to floats where possible."""
    if isinstance(value, dict):
        return {name: as_numbers(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [as_numbers(entry) for entry in value]
    try:
        return float(value)
    except ValueError:
        return value


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("number", "flags"),
    [(number, flags) for number in TYPES for flags in WAYS if (number, flags) != (np.float16, WAYS[1])],
)
def test_matrices_of_every_type_are_read_as_opencv_reads_them(tmp_path, kind, flags, number):
    rng = np.random.default_rng(3)
    matrix = np.diag([*rng.uniform(50, 120, 2), 1]).astype(number)
    matrix[0, 2], matrix[1, 2] = 100, 90
    distortion = (rng.uniform(0, 1, 5) * 10.0 ** np.array([0, -1, -5, -9, -12])).astype(number)
    storage = written(kind, flags)
    for side in "12":
        storage.write(f"M{side}", matrix)
        storage.write(f"D{side}", distortion.reshape(5, 1))
    storage.write("R", np.eye(3).astype(number))
    storage.write("T", np.array([[[1, 2, 3]]], number))  # one element with three channels
    text = storage.releaseAndGetString()
    (tmp_path / "calib").write_text(text)
    rig = read_rig(tmp_path / "calib")
    np.testing.assert_array_equal(rig.left.matrix, read_by_opencv(text, "M1"))
    np.testing.assert_array_equal(rig.right.distortion, read_by_opencv(text, "D2").ravel())
    np.testing.assert_array_equal(rig.translation_m, np.array([1, 2, 3]) / 1000)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("flags", WAYS)
def test_a_rig_that_opencv_writes_is_read_bit_by_bit(tmp_path, kind, flags):
    rng = np.random.default_rng(7)
    matrix = np.array([[1 / 3e-3, 0, 1e2 / 7], [0, 1e5 / 3, np.pi], [0, 0, 1]])
    rotation = cv2.Rodrigues(rng.normal(0, 0.1, 3))[0]
    translation_m = rng.normal(0, 0.1, 3)
    storage = written(kind, flags)
    storage.writeComment("a comment: of a line", False)
    for side in "12":
        storage.write(f"cameraMatrix{side}", matrix)
        storage.write(f"distCoeffs{side}", rng.normal(0, 1e-7, (1, 14)) if side == "1" else np.zeros((1, 4)))
    storage.writeComment("behind it", True)
    storage.write("R", rotation)
    storage.write("T", translation_m)  # one-dimensional
    storage.write("translation_unit", "m")
    storage.write("distortion_model", "plumb bob")
    storage.write("points", rng.normal(0, 1, (50, 1, 2)).astype(np.float32))
    storage.write("error", float("nan"))
    storage.startWriteStruct("image_size", cv2.FileNode_SEQ)
    for side_px in (640, 480):
        storage.write("", side_px)
    storage.endWriteStruct()
    (tmp_path / "calib").write_text(storage.releaseAndGetString())
    rng = np.random.default_rng(7)
    rng.normal(0, 0.1, 6)
    expected = Rig(
        left=Optics(matrix=matrix, distortion=rng.normal(0, 1e-7, 14)),
        right=Optics(matrix=matrix, distortion=np.zeros(4)),
        rotation=rotation,
        translation_m=translation_m,
        size_px=(640, 480),
    )
    found = read_rig(tmp_path / "calib")
    for one, other in ((found.left, expected.left), (found.right, expected.right)):
        np.testing.assert_array_equal(one.matrix, other.matrix)
        np.testing.assert_array_equal(one.distortion, other.distortion)
    np.testing.assert_array_equal(found.rotation, expected.rotation)
    np.testing.assert_array_equal(found.translation_m, expected.translation_m)
    assert (found.size_px, found.notes) == ((640, 480), ())


@pytest.mark.parametrize("kind", KINDS)
def test_lenses_without_distortion_may_have_an_empty_matrix(tmp_path, kind):
    storage = written(kind)
    for side in "12":
        storage.write(f"M{side}", np.eye(3))
        storage.write(f"D{side}", np.zeros((0, 0)))
    storage.write("R", np.eye(3))
    storage.write("T", np.array([[-0.1], [0], [0]]))
    (tmp_path / "calib").write_text(storage.releaseAndGetString())
    assert read_rig(tmp_path / "calib").left.distortion.size == 0


@pytest.mark.parametrize("kind", KINDS)
def test_opencv_s_maps_sequences_and_strings_are_the_same_in_all_its_formats(kind):
    storage = written(kind)
    storage.write("count", 640)
    storage.write("small", -1e-05)
    storage.write("word", "m")
    storage.write("words", "two words: é <&> #, x")
    storage.write("nothing", "")
    storage.startWriteStruct("sequence", cv2.FileNode_SEQ)
    storage.write("", -640)
    storage.write("", "a b")
    storage.startWriteStruct("", cv2.FileNode_SEQ)
    storage.write("", 1.0)
    storage.write("", 2.5)
    storage.endWriteStruct()
    storage.startWriteStruct("", cv2.FileNode_MAP)
    storage.write("x", 1.0)
    storage.endWriteStruct()
    storage.endWriteStruct()
    storage.startWriteStruct("map", cv2.FileNode_MAP)
    storage.write("y", 2)
    storage.endWriteStruct()
    assert as_numbers(parse_entries(storage.releaseAndGetString())) == {
        "count": 640,
        "small": -1e-05,
        "word": "m",
        "words": "two words: é <&> #, x",
        "nothing": "",
        "sequence": [-640, "a b", [1, 2.5], {"x": 1}],
        "map": {"y": 2},
    }


@pytest.mark.parametrize(
    "text", ["", "[1, 2]", "a word", "<opencv_storage/>", "<svg/>", "{", "a: *b", "a: [1"]
)
def test_text_without_named_entries_is_refused(text):
    with pytest.raises((ValueError, SyntaxError)):
        parse_entries(text)


def test_text_of_another_kind_is_named_by_its_line():
    with pytest.raises(ValueError, match="^it is not valid YAML in line 2$"):
        parse_entries("a: 1\nb: c: d\n")


def test_values_are_strings_with_any_tag_or_form():
    text = "a: 1\nb: 2001-01-01\nc: !!int 2\nd: '~'\ne: !!python/name:os.system\nf: yes\n<<: {g: 1:59}\n"
    assert parse_entries(text) == {
        **{"a": "1", "b": "2001-01-01", "c": "2", "d": "~", "e": "", "f": "yes"},
        "<<": {"g": "1:59"},
    }


def test_null_entries_are_left_out_and_nulls_elsewhere_are_strings():
    text = "a: ~\nb: null\nc:\nd: ''\ne: {f: NULL, g: [~, null]}\n"
    assert parse_entries(text) == {"d": "", "e": {"g": ["~", "null"]}}
    assert parse_entries('{"a": null, "b": "null"}') == {"b": "null"}
