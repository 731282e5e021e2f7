"""Parts of the package to mutate, and the test files that may cover them."""

from pathlib import Path
from typing import NamedTuple


class Target(NamedTuple):
    """Part of the package, defined by glob patterns.

    Attributes:
        sources: Source files below stereoweave/.
        tests: Test files below tests/, whose coverage is measured test by test.
        elsewhere: Whether some code runs in processes that are killed before they write their coverage, such
            as Ray workers. If so, every test of the first pattern counts as covering every line.
    """

    sources: tuple[str, ...]
    tests: tuple[str, ...]
    elsewhere: bool = False

    def source_files(self, root: Path) -> list[str]:
        """Return the source files, relative to the root of the repository."""
        return _found(root, "stereoweave", self.sources)

    def test_files(self, root: Path) -> list[str]:
        """Return the test files, relative to the root of the repository."""
        return _found(root, "tests", self.tests)

    def own_test_files(self, root: Path) -> list[str]:
        """Return the test files of the first pattern, relative to the root of the repository."""
        return _found(root, "tests", self.tests[:1])


TARGETS = {
    "io": Target(
        ("io/files.py", "io/images.py", "io/maps.py", "io/decoding.py"),
        (
            "io/test_files.py",
            "io/test_images.py",
            "io/test_maps.py",
            "io/test_decoding.py",
            "cli/test_bad_input.py",
            "pictures/test_loading.py",
            "data/test_readers.py",
            "io/test_exif.py",
            "outputs/test_results.py",
        ),
    ),
    "matching": Target(
        ("matching/estimate.py",),
        (
            "matching/test_estimate.py",
            "rendering/test_synthesize.py",
            "matching/opencv_interface/test_stereo_matcher.py",
            "matching/test_disparity_range.py",
            "test_wrong_arguments.py",
        ),
    ),
    "calibration": Target(
        ("cameras/rig.py", "cameras/calibration_files.py"),
        (
            "cameras/test_rig.py",
            "cameras/test_hostile_calibrations.py",
            "io/test_structured_text.py",
            "data/test_readers.py",
            "cameras/test_calibrate.py",
            "cameras/test_rectify.py",
            "cli/test_rig.py",
        ),
    ),
    "batch": Target(
        ("batch/local.py",),
        (
            "batch/test_local.py",
            "pictures/test_pair_finding.py",
            "test_names.py",
            "io/test_output_lock.py",
        ),
    ),
    "service": Target(("service/*.py",), ("service/test_*.py",), elsewhere=True),
    "checkpoint": Target(
        ("learn/checkpoint.py",), ("learn/test_checkpoint.py", "learn/training/test_loop.py")
    ),
    "rendering": Target(
        ("rendering/renderer.py",),
        (
            "rendering/test_renderer.py",
            "rendering/test_background_kernels.py",
            "rendering/test_camera_motion.py",
            "rendering/test_synthesize.py",
            "rendering/test_layouts.py",
            "test_wrong_arguments.py",
        ),
    ),
}


def _found(root: Path, folder: str, patterns: tuple[str, ...]) -> list[str]:
    files = {path for pattern in patterns for path in (root / folder).glob(pattern)}
    return sorted(str(path.relative_to(root)) for path in files)
