"""Parameters of OpenCV's stereo matchers, with OpenCV's names, getters, setters and files."""

from collections.abc import Sequence
from pathlib import Path

import cv2

from stereoweave.arguments import check_kind, check_whole_number, describe
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.files import replacing

Rectangle = tuple[int, int, int, int]
"""Column and row of the top left pixel, width and height."""

_LARGEST_PX = 2047
_LARGEST_INT = 2**31 - 1
_FILE_FORMAT, _FILE_NAME, _NODE_NAME = 3, "StereoMatcher.SGBM", "my_object"
# StereoBM's parameters that StereoSGBM does not have, with StereoBM's defaults.
_BLOCK_MATCHING = {"preFilterType": 1, "preFilterSize": 9, "textureThreshold": 10, "smallerBlockSize": 0}


class Settings:
    """Parameters of cv2.StereoSGBM and cv2.StereoBM; a setter refuses values that OpenCV cannot hold.

    A new value of minDisparity or numDisparities must leave all disparities within -2046 to 2047 px.
    """

    def __init__(self, **numbers: int) -> None:
        self._numbers: dict[str, int] = {}
        self._roi1: Rectangle = (0, 0, 0, 0)
        self._roi2: Rectangle = (0, 0, 0, 0)
        self._set(**_BLOCK_MATCHING | numbers)

    def getMinDisparity(self) -> int:
        return self._numbers["minDisparity"]

    def setMinDisparity(self, minDisparity: int) -> None:
        self._set(minDisparity=minDisparity)

    def getNumDisparities(self) -> int:
        return self._numbers["numDisparities"]

    def setNumDisparities(self, numDisparities: int) -> None:
        self._set(numDisparities=numDisparities)

    def getBlockSize(self) -> int:
        return self._numbers["blockSize"]

    def setBlockSize(self, blockSize: int) -> None:
        self._set(blockSize=blockSize)

    def getSpeckleWindowSize(self) -> int:
        return self._numbers["speckleWindowSize"]

    def setSpeckleWindowSize(self, speckleWindowSize: int) -> None:
        self._set(speckleWindowSize=speckleWindowSize)

    def getSpeckleRange(self) -> int:
        return self._numbers["speckleRange"]

    def setSpeckleRange(self, speckleRange: int) -> None:
        self._set(speckleRange=speckleRange)

    def getDisp12MaxDiff(self) -> int:
        return self._numbers["disp12MaxDiff"]

    def setDisp12MaxDiff(self, disp12MaxDiff: int) -> None:
        self._set(disp12MaxDiff=disp12MaxDiff)

    def getPreFilterCap(self) -> int:
        return self._numbers["preFilterCap"]

    def setPreFilterCap(self, preFilterCap: int) -> None:
        self._set(preFilterCap=preFilterCap)

    def getUniquenessRatio(self) -> int:
        return self._numbers["uniquenessRatio"]

    def setUniquenessRatio(self, uniquenessRatio: int) -> None:
        self._set(uniquenessRatio=uniquenessRatio)

    def getP1(self) -> int:
        return self._numbers["P1"]

    def setP1(self, P1: int) -> None:
        self._set(P1=P1)

    def getP2(self) -> int:
        return self._numbers["P2"]

    def setP2(self, P2: int) -> None:
        self._set(P2=P2)

    def getMode(self) -> int:
        return self._numbers["mode"]

    def setMode(self, mode: int) -> None:
        self._set(mode=mode)

    def getPreFilterType(self) -> int:
        return self._numbers["preFilterType"]

    def setPreFilterType(self, preFilterType: int) -> None:
        self._set(preFilterType=preFilterType)

    def getPreFilterSize(self) -> int:
        return self._numbers["preFilterSize"]

    def setPreFilterSize(self, preFilterSize: int) -> None:
        self._set(preFilterSize=preFilterSize)

    def getTextureThreshold(self) -> int:
        return self._numbers["textureThreshold"]

    def setTextureThreshold(self, textureThreshold: int) -> None:
        self._set(textureThreshold=textureThreshold)

    def getSmallerBlockSize(self) -> int:
        return self._numbers["smallerBlockSize"]

    def setSmallerBlockSize(self, blockSize: int) -> None:
        self._set(smallerBlockSize=blockSize)

    def getROI1(self) -> Rectangle:
        return self._roi1

    def setROI1(self, roi1: Sequence[int]) -> None:
        self._roi1 = _check_rectangle("roi1", roi1)

    def getROI2(self) -> Rectangle:
        return self._roi2

    def setROI2(self, roi2: Sequence[int]) -> None:
        self._roi2 = _check_rectangle("roi2", roi2)

    def clear(self) -> None:
        """Do nothing, because a matcher keeps nothing between pairs."""

    def empty(self) -> bool:
        """Return False: a matcher is always ready."""
        return False

    def getDefaultName(self) -> str:
        """Return the name of the node that `save` writes."""
        return _NODE_NAME

    def save(self, filename: str | Path) -> None:
        """Write the parameters of StereoSGBM to a YAML, XML or JSON file that OpenCV can read, too."""
        check_kind("filename", filename, str, Path)
        with replacing(filename) as temporary:
            storage = cv2.FileStorage(str(temporary), cv2.FILE_STORAGE_WRITE)
            self.write(storage, _NODE_NAME)
            storage.release()

    def write(self, fs: cv2.FileStorage, name: str = "") -> None:
        """Write the parameters of StereoSGBM to an open file, in a node of this name if there is one."""
        check_kind("fs", fs, cv2.FileStorage)
        check_kind("name", name, str)
        if name:
            fs.startWriteStruct(name, cv2.FileNode_MAP)
        fs.write("format", _FILE_FORMAT)
        fs.write("name", _FILE_NAME)
        for key, number in self._numbers.items():
            if key not in _BLOCK_MATCHING:
                fs.write(key, number)
        if name:
            fs.endWriteStruct()

    def read(self, fn: cv2.FileNode) -> None:
        """Set the parameters from a node that StereoSGBM, StereoBM or `write` has written."""
        check_kind("fn", fn, cv2.FileNode)
        nodes = {key: fn.getNode(key) for key in self._numbers} if fn.isMap() else {}
        found = {key: int(node.real()) for key, node in nodes.items() if node.isInt()}
        if not found:
            raise FormatError(
                "fn: expected a node with the parameters of a stereo matcher, found none; "
                f"read the node {_NODE_NAME} of the file"
            )
        self._set(**found)

    def _set(self, **numbers: int) -> None:
        whole = {name: check_whole_number(name, number) for name, number in numbers.items()}
        for name, number in whole.items():
            if not -_LARGEST_INT <= number <= _LARGEST_INT:
                raise StereoweaveError(f"{name}: expected a number that fits in 32 bits, got {number}")
        changed = self._numbers | whole
        _check_range(changed["minDisparity"], changed["numDisparities"])
        self._numbers = changed


def _check_range(least_px: int, count: int) -> None:
    # The value below minDisparity marks invalid pixels.
    if count < 1 or least_px - 1 < -_LARGEST_PX or least_px + count > _LARGEST_PX:
        raise StereoweaveError(
            f"expected numDisparities of at least 1 and disparities from {1 - _LARGEST_PX} to "
            f"{_LARGEST_PX} px, which fit in int16 in units of 1/16 px, found minDisparity {least_px} "
            f"and numDisparities {count}; use stereoweave.estimate, which returns floats"
        )


def _check_rectangle(name: str, rectangle: Sequence[int]) -> Rectangle:
    try:
        x, y, width, height = rectangle
    except (TypeError, ValueError) as error:
        raise StereoweaveError(
            f"{name}: expected a rectangle (x, y, width, height), got {describe(rectangle)}"
        ) from error
    x, y, width, height = (check_whole_number(name, number) for number in (x, y, width, height))
    return x, y, width, height
