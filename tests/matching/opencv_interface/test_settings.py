"""The parameters of StereoMatcher are those of cv2.StereoSGBM and cv2.StereoBM of the installed OpenCV."""

import inspect
import re

import cv2
import numpy as np
import pytest

import stereoweave as sw
from stereoweave.errors import FormatError, StereoweaveError

THEIRS = [cv2.StereoSGBM, cv2.StereoBM]
KINDS = pytest.mark.parametrize("theirs", THEIRS)
ROI = (3, 4, 50, 60)


def methods(kind: type) -> set[str]:
    return {name for name in dir(kind) if not name.startswith("_")}


def arguments(documented: str) -> list[str]:
    """Return the names in OpenCV's description of a function, as in "create([, a[, b]]) -> retval"."""
    (names,) = re.findall(r"^\w+\((.*?)\) ->", documented)
    return re.findall(r"\w+", names)


def properties(kind: type) -> set[str]:
    return {name[3:] for name in methods(kind) if name.startswith("set")}


@KINDS
def test_every_method_of_opencv_exists_with_the_same_arguments(theirs):
    assert len(methods(theirs)) > 25
    for name in methods(theirs) - {"create"}:
        described = getattr(theirs, name).__doc__.strip().splitlines()
        ours = list(inspect.signature(getattr(sw.StereoMatcher, name)).parameters)[1:]
        assert ours[: len(arguments(described[0]))] == arguments(described[0]), name


def test_the_arguments_are_those_of_sgbm_in_its_order():
    names = arguments(cv2.StereoSGBM.create.__doc__)
    assert names[:3] == ["minDisparity", "numDisparities", "blockSize"]
    assert list(inspect.signature(sw.StereoMatcher).parameters)[: len(names)] == names
    values = range(1, len(names) + 1)
    theirs, ours = cv2.StereoSGBM.create(*values), sw.StereoMatcher.create(*values)
    for name in properties(cv2.StereoSGBM):
        assert getattr(ours, f"get{name}")() == getattr(theirs, f"get{name}")(), name


def test_the_arguments_of_bm_are_taken_by_name():
    names = arguments(cv2.StereoBM.create.__doc__)
    assert names == ["numDisparities", "blockSize"]
    ours = sw.StereoMatcher.create(**dict.fromkeys(names, 48))
    assert (ours.getNumDisparities(), ours.getBlockSize()) == (48, 48)


@KINDS
def test_a_getter_returns_what_was_set_as_opencv_s_does(theirs):
    matchers = theirs.create(), sw.StereoMatcher()
    for value, name in enumerate(sorted(properties(theirs)), 16):
        for matcher in matchers:
            getattr(matcher, f"set{name}")(ROI if name.startswith("ROI") else value)
    for name in properties(theirs) - {"SmallerBlockSize"}:  # OpenCV accepts it and returns 0
        theirs_then, ours_then = (getattr(matcher, f"get{name}")() for matcher in matchers)
        assert ours_then == theirs_then, name
        assert ours_then == ROI or 16 <= ours_then < 40


def test_the_defaults_are_those_of_sgbm_but_for_the_number_of_disparities():
    ours, sgbm, bm = sw.StereoMatcher(), cv2.StereoSGBM.create(), cv2.StereoBM.create()
    assert (ours.getNumDisparities(), sgbm.getNumDisparities()) == (192, 16)
    for name in properties(cv2.StereoSGBM) - {"NumDisparities"}:
        assert getattr(ours, f"get{name}")() == getattr(sgbm, f"get{name}")(), name
    for name in properties(cv2.StereoBM) - properties(cv2.StereoSGBM):
        assert getattr(ours, f"get{name}")() == getattr(bm, f"get{name}")(), name
    assert (ours.empty(), ours.getDefaultName()) == (sgbm.empty(), sgbm.getDefaultName())


@pytest.mark.parametrize("ending", [".yml", ".xml", ".json"])
def test_opencv_reads_what_is_saved(tmp_path, ending):
    ours = sw.StereoMatcher(-8, 48, P1=600, P2=2400, speckleRange=2)
    ours.save(tmp_path / f"matcher{ending}")
    ours.clear()
    theirs = cv2.StereoSGBM.create()
    storage = cv2.FileStorage(str(tmp_path / f"matcher{ending}"), cv2.FILE_STORAGE_READ)
    theirs.read(storage.getNode("my_object"))
    for name in properties(cv2.StereoSGBM):
        assert getattr(theirs, f"get{name}")() == getattr(ours, f"get{name}")(), name
    assert [path.name for path in tmp_path.iterdir()] == [f"matcher{ending}"]


@KINDS
def test_what_opencv_saves_is_read(tmp_path, theirs):
    saved = theirs.create(numDisparities=48, blockSize=7)
    saved.setDisp12MaxDiff(5)
    saved.save(str(tmp_path / "matcher.yml"))
    ours = sw.StereoMatcher()
    storage = cv2.FileStorage(str(tmp_path / "matcher.yml"), cv2.FILE_STORAGE_READ)
    ours.read(storage.getNode("my_object"))
    for name in properties(theirs) - {"ROI1", "ROI2", "SmallerBlockSize"}:  # OpenCV does not save them
        assert getattr(ours, f"get{name}")() == getattr(saved, f"get{name}")(), name


def test_the_parameters_are_written_to_an_open_file_as_opencv_writes_them():
    written = []
    for matcher in (cv2.StereoSGBM.create(-4, 32, 5), sw.StereoMatcher(-4, 32, 5)):
        for name in ((), ("mine",)):
            storage = cv2.FileStorage("matcher.yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
            matcher.write(storage, *name)
            written.append(storage.releaseAndGetString())
    assert written[:2] == written[2:]
    assert "mine:" in written[1]


def test_a_node_without_parameters_is_refused():
    with pytest.raises(FormatError, match="^fn: expected .* parameters .* read the node my_object"):
        sw.StereoMatcher().read(cv2.FileNode())


def test_a_refused_value_leaves_the_parameters_unchanged():
    matcher = sw.StereoMatcher(-8, 40)
    changes = {matcher.setNumDisparities: 3000, matcher.setP1: 2**31, matcher.setROI1: ROI[1:]}
    for change, value in changes.items():
        with pytest.raises(StereoweaveError):
            change(value)
    assert (matcher.getNumDisparities(), matcher.getP1(), matcher.getROI1()) == (40, 0, (0, 0, 0, 0))


@pytest.mark.usefixtures("without_shape_checks")
def test_numbers_of_numpy_are_taken():
    matcher = sw.StereoMatcher()
    matcher.setBlockSize(np.int32(5))
    matcher.setROI2(np.array(ROI))
    assert (matcher.getBlockSize(), matcher.getROI2()) == (5, ROI)
