"""The results that the page keeps for its visitors."""

import shutil
from collections import OrderedDict
from threading import Lock
from uuid import uuid4

from stereoweave.app.session import Session

GONE = (
    "This result has expired: results are kept for an hour, and only the last four of all visitors. "
    "Find depth again."
)


class SessionStore:
    """The visitors' latest results; of more than `most`, the one that was used longest ago is removed.

    Gradio's own limit counts all windows, also those without a result, and leaves the files of a result.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._sessions: OrderedDict[str, Session] = OrderedDict()
        self._lock = Lock()

    def keep(self, session: Session, instead_of: str | None) -> str:
        """Keep a result instead of the visitor's earlier one, and return the key by which it is found."""
        self.remove(instead_of)
        key = uuid4().hex
        with self._lock:
            self._sessions[key] = session
            others = [*self._sessions][: -self._most]
        for other in others:
            self.remove(other)
        return key

    def find(self, key: str | None) -> Session | None:
        """Return the result of a key; None if there is none, or if it was removed."""
        with self._lock:
            session = self._sessions.get(key or "")
            if session:
                self._sessions.move_to_end(key or "")
        return session

    def remove(self, key: str | None) -> None:
        """Remove a result that is no longer shown, with its files."""
        with self._lock:
            session = self._sessions.pop(key or "", None)
        if session:
            shutil.rmtree(session.folder, ignore_errors=True)

    def keeps(self, key: str | None, session: Session) -> bool:
        """Return whether a result is still kept; if it is not, remove what was written for it meanwhile."""
        if self.find(key) is session:
            return True
        shutil.rmtree(session.folder, ignore_errors=True)
        return False
