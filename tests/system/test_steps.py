import numpy as np
import pytest

from stereoweave.matching.upsample import enlarge
from stereoweave.stereo import Estimate
from stereoweave.system.steps import listening, step
from stereoweave.system.threads import in_bands


@pytest.fixture
def told():
    """Listen to the steps of a test. Returns the list of what was told."""
    told = []
    with listening(lambda step: told.append(step and (step.name, step.done, step.total))):
        yield told


def test_the_innermost_step_is_told_and_after_it_the_outer_one(told):
    with step("matching"), step("refining"):
        pass
    assert told == [("matching", 0, None), ("refining", 0, None), ("matching", 0, None), None]


def test_finished_parts_add_up(told):
    with step("writing", total=5) as advance:
        advance(2)
        advance(3)
    assert told == [("writing", 0, 5), ("writing", 2, 5), ("writing", 5, 5), None]


def test_a_step_ends_with_an_error(told):
    with pytest.raises(ZeroDivisionError), step("dividing"):
        raise ZeroDivisionError
    assert told == [("dividing", 0, None), None]


def test_a_decorated_function_is_a_step_at_every_call(told):
    @step("doubling")
    def double(number):
        return 2 * number

    assert [double(1), double(2)] == [2, 4]
    assert told == [("doubling", 0, None), None] * 2


def test_without_a_listener_steps_pass_in_silence(capfd):
    with step("matching", total=2) as advance:
        advance(2)
    assert capfd.readouterr() == ("", "")


def test_the_error_of_a_listener_ends_the_job():
    def cancel(step):
        raise InterruptedError

    with listening(cancel), pytest.raises(InterruptedError), step("matching"):
        pytest.fail("the job went on")


def test_threads_on_bands_of_rows_are_heard_too(told):
    def work(first, end):
        with step(f"rows {first} to {end}"):
            pass

    in_bands(work, 8, count=2, threads=1)
    assert told == [("rows 0 to 4", 0, None), None, ("rows 4 to 8", 0, None), None]


def test_upsampling_tells_how_much_of_it_is_done(told, rng):
    left = rng.integers(0, 256, (80, 96, 3), np.uint8)
    px = np.zeros((20, 24), np.float32)
    small = Estimate(disparity_px=px, right_disparity_px=px, confidence=px, occluded=px > 0)
    enlarge(left, left, small, threads=1)
    _, parts, pixels = zip(*[each for each in told if each and each[0] == "upsampling"], strict=True)
    # Both views, once upwards and once downwards, at half and at full size.
    assert set(pixels) == {2 * 2 * (40 * 48 + 80 * 96)}
    assert list(parts) == sorted(parts)
    assert (parts[0], parts[-1]) == (0, 38400)
