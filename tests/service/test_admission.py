from pathlib import Path

import pytest

from stereoweave.matching.options import MatchOptions
from stereoweave.service.admission import Budget, BusyError
from stereoweave.service.answers import ServiceJob, TooLargeError


def job(**said) -> ServiceJob:
    return ServiceJob(folder=Path(), pictures=(Path("left"), Path("right")), **{"file": "depth.png", **said})


def test_a_job_that_alone_takes_longer_than_the_time_limit_is_refused():
    budget = Budget(seconds_each=2, limit_s=20)
    with budget.admit(job(), megapixels=4, left_s=20):
        pass
    with pytest.raises(TooLargeError, match="at most 20 s, found 4.2 megapixels that take 21 s"):
        budget.admit(job(), megapixels=4.2, left_s=15).__enter__()


def test_a_job_that_takes_longer_than_the_remaining_time_may_be_sent_again():
    budget = Budget(seconds_each=2, limit_s=20)
    with pytest.raises(BusyError, match="expected more than 15.0 s for this request, found 12.0 s left; try"):
        budget.admit(job(), megapixels=3, left_s=12).__enter__()


def test_a_job_that_would_be_late_after_pending_jobs_may_be_retried_when_they_are_done():
    budget = Budget(seconds_each=2, limit_s=20)
    with budget.admit(job(), megapixels=2, left_s=5), budget.admit(job(), megapixels=0.5, left_s=5):
        with pytest.raises(BusyError, match="make this request 2 s late") as busy:
            budget.admit(job(), megapixels=0.8, left_s=5).__enter__()
        assert busy.value.retry_after_s == 2  # 4 + 1 + 1.6 - 5, rounded up
    with budget.admit(job(), megapixels=2, left_s=5):
        pass


def test_without_pending_jobs_any_job_that_the_best_speed_allows_is_accepted():
    budget = Budget(seconds_each=2, limit_s=20)
    budget.learn(work=10, took_s=10)
    budget.learn(work=10, took_s=500)
    with budget.admit(job(), megapixels=2, left_s=2):
        pass


def test_pending_jobs_are_expected_to_run_at_the_usual_speed():
    budget = Budget(seconds_each=1, limit_s=20)
    for took_s in (30, 30, 500):
        budget.learn(work=10, took_s=took_s)
    with budget.admit(job(), megapixels=1, left_s=6):
        with pytest.raises(BusyError, match="make this request 3 s late"):
            budget.admit(job(), megapixels=2, left_s=6).__enter__()
        with budget.admit(job(), megapixels=1, left_s=6):
            pass


def test_old_speeds_are_forgotten():
    budget = Budget(seconds_each=50, limit_s=20)
    for _ in range(9):
        budget.learn(work=1, took_s=2)
    with budget.admit(job(), megapixels=1, left_s=4), budget.admit(job(), megapixels=1, left_s=4):
        pass


def test_an_unfinished_job_slows_the_usual_speed_but_leaves_the_best_speed_unchanged():
    budget = Budget(seconds_each=2, limit_s=20)
    budget.learn(work=1, took_s=8, finished=False)
    budget.learn(work=8, took_s=1, finished=False)  # stopped early, so it counts as the median, 5
    with budget.admit(job(), megapixels=1, left_s=2), pytest.raises(BusyError, match="request 1 s late"):
        budget.admit(job(), megapixels=1, left_s=9).__enter__()  # twice the median of 2, 5 and 8, minus 9
    with pytest.raises(BusyError, match="than 2.0 s for this request, found 1.9 s"):
        budget.admit(job(), megapixels=1, left_s=1.9).__enter__()


def test_large_pictures_and_full_resolution_are_more_work():
    budget = Budget(seconds_each=2, limit_s=20)
    assert budget.estimate_work(job(), 0.6) == 0.6
    assert budget.estimate_work(job(), 50) == 125
    assert budget.estimate_work(job(options=MatchOptions(refined=True)), 1) == 1.3
    assert budget.estimate_work(job(file="view.png"), 1) == 1.3


def test_full_resolution_is_no_more_work_for_a_matcher_that_always_refines():
    assert Budget(seconds_each=2, limit_s=20, refines=True).estimate_work(job(file="view.png"), 1) == 1
