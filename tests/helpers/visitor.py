"""Drive the page over HTTP like its script, without a browser, which would access the network itself."""

from pathlib import Path
from typing import Any

import httpx


class Visitor:
    """A visitor of the page, connected by a client."""

    def __init__(self, client: httpx.Client) -> None:
        self._client = client
        self._client.get("/").raise_for_status()
        config = self._client.get("/config").json()
        self._parts = {part["id"]: part["props"] for part in config["components"]}
        self._events = config["dependencies"]

    def press(self, button: str, **files: Path) -> str:
        """Press a button with files in the named fields; return the page's answer."""
        (*_, event) = [each for each in self._events if button in map(self._name_of, each["targets"])]
        given = {field: self._uploaded(path) for field, path in files.items()}
        parts = [self._parts[part] for part in event["inputs"]]
        data = [given.get(part.get("elem_id"), part.get("value")) for part in parts]
        join = {"data": data, "fn_index": event["id"], "session_hash": "visitor"}
        self._client.post("/gradio_api/queue/join", json=join).raise_for_status()
        with self._client.stream("GET", "/gradio_api/queue/data?session_hash=visitor") as stream:
            (answer,) = [line for line in stream.iter_lines() if '"process_completed"' in line]
        return answer

    def _name_of(self, target: list[Any]) -> str | None:
        return self._parts.get(target[0], {}).get("elem_id")

    def _uploaded(self, path: Path) -> dict[str, Any]:
        with path.open("rb") as file:
            answer = self._client.post("/gradio_api/upload", files={"files": file})
        return {"path": answer.json()[0], "orig_name": path.name, "meta": {"_type": "gradio.FileData"}}
