from spatial_examples import SPATIAL, SPATIAL_FRAMES

from experiments.whole_films.conversion import measure_conversions


def test_a_conversion_is_compared_with_the_film_and_keeps_its_times_and_sound():
    (row,) = measure_conversions(SPATIAL, ["depth"])
    assert (row.film, row.output, row.width_px, row.height_px) == ("pan.mp4", "depth", 320, 192)
    assert (row.frames, row.lost_frames, row.added_frames) == (SPATIAL_FRAMES, 0, 0)
    assert row.sound_packets > 0
    assert row.sound_is_equal
    # A process with its libraries takes at least this much.
    assert row.peak_mb > 100
    assert row.frames_per_s > 0
