"""Which sources are mutated, and which test files may cover them."""

from pathlib import Path
from typing import NamedTuple


class Target(NamedTuple):
    """A part of the package, by glob patterns.

    Attributes:
        sources: Files below stereoweave/.
        tests: Test files below tests/. What each test covers is measured.
        elsewhere: Whether some of it runs in processes that are killed before their coverage is written, as
            Ray's are. Then all tests of the first pattern count as covering each line.
    """

    sources: tuple[str, ...]
    tests: tuple[str, ...]
    elsewhere: bool = False

    def source_files(self, root: Path) -> list[str]:
        """The sources, relative to the repository's root."""
        return _found(root, "stereoweave", self.sources)

    def test_files(self, root: Path) -> list[str]:
        """The test files, relative to the repository's root."""
        return _found(root, "tests", self.tests)

    def own_test_files(self, root: Path) -> list[str]:
        """The test files of the first pattern."""
        return _found(root, "tests", self.tests[:1])


TARGETS = {
    "io": Target(
        ("io.py", "picture_files.py"),
        (
            "test_io*.py",
            "test_bad_input.py",
            "test_picture*.py",
            "test_readers.py",
            "test_exif.py",
            "test_results.py",
        ),
    ),
    "matching": Target(
        ("matching.py",),
        (
            "test_matching.py",
            "test_synthesis.py",
            "test_stereo_matcher.py",
            "test_ranging.py",
            "test_wrong_arguments.py",
        ),
    ),
    "calibration": Target(
        ("calibration.py", "calibration_files.py"),
        (
            "test_calibration*.py",
            "test_hostile_calibrations.py",
            "test_structured_text.py",
            "test_readers.py",
            "test_boards.py",
            "test_rectify.py",
            "test_rig_commands.py",
        ),
    ),
    "batch": Target(
        ("batch.py",), ("test_batch.py", "test_pair_lists.py", "test_names.py", "test_output_lock.py")
    ),
    "service": Target(("service*.py",), ("test_service*.py", "test_proxy.py"), elsewhere=True),
    "checkpoint": Target(("learn/checkpoint.py",), ("test_checkpoint.py", "test_train.py")),
    "rendering": Target(
        ("rendering.py",),
        (
            "test_rendering.py",
            "test_hidden.py",
            "test_moving.py",
            "test_synthesis.py",
            "test_layouts.py",
            "test_wrong_arguments.py",
        ),
    ),
}


def _found(root: Path, folder: str, patterns: tuple[str, ...]) -> list[str]:
    files = {path for pattern in patterns for path in (root / folder).glob(pattern)}
    return sorted(str(path.relative_to(root)) for path in files)
