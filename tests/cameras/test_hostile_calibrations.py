import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hostile_calibrations import HARMLESS, HOSTILE, RIG, json_of, xml_of, yaml_of

from stereoweave.cameras.calibration_files import read_rig
from stereoweave.errors import FormatError
from stereoweave.io.files import MOST_SMALL_BYTES
from stereoweave.outputs.results import DepthJob, job_facts
from stereoweave.pictures.prepare import Request

WITHOUT_LIMIT = ["/dev/zero", "/dev/urandom"]
# Runs in a separate process that may grow by 100 MB; the test fails if it runs out of memory or dies.
GROWING = """
import resource, sys
sys.path.insert(0, sys.argv[1])
from hostile_calibrations import HOSTILE
from pathlib import Path
from stereoweave.cameras.calibration_files import read_rig
from stereoweave.errors import FormatError

pages = int(Path("/proc/self/statm").read_text().split()[0])
resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + 100 * 10**6,) * 2)
path = Path(sys.argv[2])
for name, content in HOSTILE.items():
    if name.startswith(("aliases", "nesting", "entities", "matrices")):
        path.write_bytes(content)
        try:
            read_rig(path)
        except FormatError:
            print(name)
"""


def refusal(path):
    """Read the file, which must fail; return the error's line."""
    with pytest.raises(FormatError) as caught:
        read_rig(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: expected")
    assert message.removeprefix(str(path)).isprintable()
    assert len(message) < len(str(path)) + 400
    return message


@pytest.mark.usefixtures("untraced")
@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_calibration_is_refused_at_once_in_one_short_line(name, tmp_path):
    (tmp_path / "calib").write_bytes(HOSTILE[name])
    start_s = time.process_time()
    refusal(tmp_path / "calib")
    # Half a second at most; what grows exponentially would take far longer.
    assert time.process_time() - start_s < 3


@pytest.mark.parametrize("text_of", [yaml_of, json_of, xml_of])
def test_a_file_of_too_many_values_says_which_to_leave_out(text_of, tmp_path):
    (tmp_path / "calib").write_text(text_of(RIG | {"image_points": [1] * 12_000}))
    message = refusal(tmp_path / "calib")
    text = "more than 10000 values; remove entries that do not describe the cameras, such as image_points"
    assert text in message


@pytest.mark.parametrize("name", HARMLESS)
def test_a_calibration_that_only_looks_odd_is_read(name, tmp_path):
    (tmp_path / "calib").write_bytes(HARMLESS[name])
    assert read_rig(tmp_path / "calib").baseline_m > 0


def test_hostile_calibrations_need_no_memory(tmp_path):
    root = Path(__file__).parents[2]  # -c imports from the working folder: fuzz, which the helper needs
    command = [sys.executable, "-c", GROWING, root / "tests" / "helpers", tmp_path / "calib"]
    process = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=60)
    assert (process.returncode, process.stderr) == (0, "")
    assert len(process.stdout.splitlines()) > 90


@pytest.mark.parametrize("device", WITHOUT_LIMIT)
def test_a_device_without_end_is_refused_in_place_of_a_calibration(device):
    assert "found a pipe or a device" in refusal(device)


def test_a_pipe_into_which_nobody_writes_is_refused_in_place_of_a_calibration(tmp_path):
    os.mkfifo(tmp_path / "calib.yml")
    assert "found a pipe or a device" in refusal(tmp_path / "calib.yml")


def test_the_calibration_recorded_by_a_batch_passes_the_same_checks(tmp_path):
    large = tmp_path / "calib"
    large.write_bytes(HOSTILE["size: json of a megabyte"])
    for path, found in ((Path("/dev/zero"), "found a pipe or a device"), (large, "bytes, found more")):
        with pytest.raises(FormatError, match=found):
            job_facts(DepthJob(request=Request(calibration=path)))


def test_the_companion_of_an_opencv_file_passes_the_same_checks(tmp_path):
    (tmp_path / "extrinsics.yml").write_text(yaml_of({name: RIG[name] for name in "RT"}))
    beside = tmp_path / "intrinsics.yml"
    for content, found in (
        (HOSTILE["aliases: recursive list"], "an alias"),
        (b"#" * (MOST_SMALL_BYTES + 1), f"at most {MOST_SMALL_BYTES} bytes"),
    ):
        beside.write_bytes(content)
        with pytest.raises(FormatError, match=found) as caught:
            read_rig(tmp_path / "extrinsics.yml")
        assert str(caught.value).startswith(f"{beside}: expected")
    beside.unlink()
    os.mkfifo(beside)
    with pytest.raises(FormatError, match="found a pipe or a device"):
        read_rig(tmp_path / "extrinsics.yml")


@pytest.mark.parametrize("text_of", [yaml_of, json_of, xml_of])
def test_a_calibration_may_be_as_large_as_the_limit_and_no_larger(text_of, tmp_path):
    path, text = tmp_path / "calib", text_of(RIG)
    path.write_text(text + "\n" * (MOST_SMALL_BYTES - len(text)))
    assert read_rig(path).size_px == (640, 480)
    path.write_text(text + "\n" * (MOST_SMALL_BYTES - len(text) + 1))
    assert "bytes, found more" in refusal(path)


@pytest.mark.parametrize(("text_of", "nested"), [(yaml_of, "[{}]"), (json_of, "[{}]"), (xml_of, "<_>{}</_>")])
def test_values_may_be_nested_20_deep_and_no_deeper(text_of, nested, tmp_path):
    path, value = tmp_path / "calib", "1"
    for depth in range(1, 20):
        path.write_text(text_of(RIG | {"more": value if text_of is not json_of or depth > 1 else 1}))
        assert read_rig(path).baseline_m == 0.1
        value = nested.format(value)
    path.write_text(text_of(RIG | {"more": nested.format(value)}))
    assert "nested more than 20 levels deep" in refusal(path)
