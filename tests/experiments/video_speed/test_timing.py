from experiments.video_speed import timing


def test_each_video_is_converted_to_each_output(monkeypatch):
    monkeypatch.setattr(timing, "SIZES_PX", ((96, 64),))
    monkeypatch.setattr(timing, "OUTPUTS", {"depth": {"depth": True}, "view": {"position": 0.5}})
    rows = list(timing.measure_speeds("ship", frames=7, turns=2))
    assert [(row.output, row.width_px, row.height_px, row.frames, row.turns) for row in rows] == [
        ("depth", 96, 64, 7, 2),
        ("view", 96, 64, 7, 2),
    ]
    for row in rows:
        assert row.frames_per_s > 0
        assert row.survey_s >= 0
        assert row.processor_ms > 0


def test_the_video_moves_there_and_back(tmp_path, monkeypatch):
    from stereoweave.video.reader import open_video

    monkeypatch.setattr(timing, "_PATH_FRAMES", 4)
    timing.write_video(tmp_path / "video.mp4", "ship", (96, 64), 8)
    video = open_video([tmp_path / "video.mp4"])
    assert (video.frame_packing, video.frame_count, video.size_px) == ("side_by_side", 8, (96, 64))
    first, *later = [frame.left.astype(int) for frame in video.frames()]
    # Frame 6 is the first one again.
    assert abs(later[5] - first).mean() < 0.5 * abs(later[2] - first).mean()
