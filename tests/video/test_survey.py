"""Survey of a video before its conversion: notes on its frames."""

import numpy as np
import pytest
from rich.console import Console
from video_examples import write_side_by_side, write_video

from stereoweave.learn.data.collage import paint_collage
from stereoweave.matching.matcher import Matcher
from stereoweave.system.progress import progress
from stereoweave.video.reader import open_video
from stereoweave.video.survey import survey_video

SIZE = (320, 240)


@pytest.fixture(scope="module")
def matcher():
    return Matcher("small", threads=1)


def survey_notes(path, matcher, *, rectified=True):
    with progress(Console(quiet=True)) as bar:
        _, notes = survey_video(open_video([path]), matcher, bar, rectified=rectified)
    return [str(note) for note in notes]


@pytest.fixture(scope="module")
def painted():
    sample = paint_collage(77, 0, 2, SIZE[1], SIZE[0])
    return sample.left, sample.right


@pytest.mark.parametrize("rectified", [True, False])
def test_a_flat_shot_is_noted_with_its_times(tmp_path, matcher, painted, rectified):
    deep, flat = painted, (painted[0], painted[0])
    pairs = [deep] * 3 + [flat] * 2 + [deep, deep, flat]
    film = write_side_by_side(tmp_path / "film_SBS.mkv", pairs)
    assert survey_notes(film, matcher, rectified=rectified) == [
        "0:00:00.120 to 0:00:00.160, 0:00:00.280 flat: both views are the same picture, so no depth can be "
        "seen"
    ]


def test_of_many_flat_shots_three_are_named(tmp_path, matcher, painted):
    pairs = [(painted[0], painted[index % 2]) for index in range(9)]
    (line,) = survey_notes(write_side_by_side(tmp_path / "film_SBS.mkv", pairs), matcher)
    assert line.startswith("0:00:00.000, 0:00:00.080, 0:00:00.160, ... flat: ")


def test_a_plain_frame_is_not_called_flat(tmp_path, matcher, painted):
    grey = np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)
    film = write_side_by_side(tmp_path / "film_SBS.mkv", [painted] * 4 + [(grey, grey)])
    assert survey_notes(film, matcher) == []


def test_a_dropped_column_is_noted(tmp_path, matcher, painted):
    odd = np.hstack([*painted, painted[1][:, :1]])
    film = write_video(tmp_path / "film_SBS.mkv", [odd] * 2, codec="ffv1")
    assert survey_notes(film, matcher) == ["the last column is dropped, because the width, 641 px, is odd"]


def test_a_note_on_most_frames_names_no_time(tmp_path, matcher, painted):
    film = write_side_by_side(tmp_path / "film_SBS.mkv", [painted[::-1]] * 3)
    (line,) = survey_notes(film, matcher)
    assert line == "left and right were swapped, and have been swapped back"


@pytest.mark.parametrize(("swapped", "noted"), [((1, 4), False), ((0, 2, 3, 5, 6), True)])
def test_eyes_are_said_to_be_swapped_back_only_if_they_are(tmp_path, matcher, painted, swapped, noted):
    """Of nine frames, 1, 4 and 7 are checked for problems; all nine decide."""
    pairs = [painted[::-1] if index in swapped else painted for index in range(9)]
    film = write_side_by_side(tmp_path / "film_SBS.mkv", pairs)
    said = "left and right were swapped, and have been swapped back"
    with progress(Console(quiet=True)) as bar:
        survey, notes = survey_video(open_video([film]), matcher, bar)
    assert survey.swapped == noted
    assert any(said in note.text for note in notes) == noted
