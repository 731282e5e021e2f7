import pytest

from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.run_folder import check_claim, check_unclaimed, describe_run, parse_description

FACTS = {"model": "small", "sizes": (3, 4)}


def test_a_description_that_is_read_back_is_the_same_claim():
    check_claim("s3://b/batch.json", FACTS, parse_description("", describe_run(FACTS), "a description"))


@pytest.mark.parametrize(
    ("found", "words"),
    [
        ({"model": "base", "sizes": [3, 4]}, 'expected model = "small" for this run, found "base"'),
        ({"model": "small"}, r"expected sizes = \[3, 4\] for this run, found null"),
        (
            {"model": "small", "sizes": [3, 4], "old": 1},
            "expected old = null for this run, found 1; use the same",
        ),
        ({}, 'expected model = "small" for this run, found null'),
    ],
)
def test_another_run_s_claim_is_refused_with_the_first_fact_that_differs(found, words):
    with pytest.raises(StereoweaveError, match=f"^s3://b/batch.json: {words}"):
        check_claim("s3://b/batch.json", FACTS, found)


@pytest.mark.parametrize(
    ("text", "found"), [("{", "one that cannot be read"), ("[1]", r"\[1\]"), ("", "one that cannot")]
)
def test_an_invalid_description_is_refused_in_one_line(text, found):
    with pytest.raises(FormatError, match=f"^out/batch.json: expected a batch's description, found {found}"):
        parse_description("out/batch.json", text, "a batch's description")


def test_a_folder_with_other_files_and_no_description_is_refused_with_the_first_name():
    check_unclaimed("out", "batch.json", iter(()))
    with pytest.raises(
        StereoweaveError,
        match="^out: expected an empty folder or one with a batch.json, found one with a.png",
    ):
        check_unclaimed("out", "batch.json", iter(("b.png", "a.png")))
