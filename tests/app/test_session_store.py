"""The page keeps the results that were used last, and removes the files of all others."""

from dataclasses import replace
from pathlib import Path

import pytest

from stereoweave.app.session import Session, Uploads, match_uploads, open_session
from stereoweave.app.session_store import SessionStore
from stereoweave.matching.backend import Backend
from stereoweave.pictures.prepare import Request

TEXTURED = Path(__file__).parents[1] / "textured_pair"


@pytest.fixture(scope="module")
def found(tmp_path_factory) -> Session:
    pictures = TEXTURED / "left.png", TEXTURED / "right.png"
    uploads = Uploads(pictures=pictures, request=Request(rectify=False), backend=Backend())
    return open_session(match_uploads(uploads, lambda share, what: None), tmp_path_factory.mktemp("result"))


@pytest.fixture
def sessions(found, tmp_path) -> list[Session]:
    """Return three results, each with a file in a folder of its own."""
    made = [replace(found, folder=tmp_path / name) for name in ("a", "b", "c")]
    for session in made:
        session.folder.mkdir()
        (session.folder / "depth.npy").touch()
    return made


def test_the_result_that_was_used_longest_ago_is_removed_with_its_files(sessions):
    store = SessionStore(2)
    first, second = (store.keep(session, None) for session in sessions[:2])
    assert store.find(first) is sessions[0]
    third = store.keep(sessions[2], None)
    assert store.find(second) is None
    assert [store.find(key) for key in (first, third)] == [sessions[0], sessions[2]]
    assert [session.folder.exists() for session in sessions] == [True, False, True]


def test_a_visitor_s_next_result_replaces_theirs_and_no_other(sessions):
    store = SessionStore(2)
    first, second = (store.keep(session, None) for session in sessions[:2])
    store.keep(sessions[2], instead_of=second)
    assert store.find(first) is sessions[0]
    assert store.find(second) is None


def test_files_that_are_written_after_their_result_was_removed_are_removed_too(sessions):
    store, session = SessionStore(2), sessions[0]
    key = store.keep(session, None)
    assert store.keeps(key, session)
    store.remove(key)
    session.folder.mkdir()
    assert not store.keeps(key, session)
    assert not session.folder.exists()


def test_without_a_key_there_is_no_result():
    store = SessionStore(2)
    store.remove(None)
    assert store.find(None) is None
