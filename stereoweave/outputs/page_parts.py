"""Parts that the report and the 3-D viewer assemble into a page, which may run only its own script."""

import base64
import hashlib
import importlib.resources
import json
from typing import Any


def read_page_part(folder: str, name: str) -> str:
    """Return a part of a page, from a folder beside this module."""
    source = importlib.resources.files("stereoweave.outputs") / folder / name
    return source.read_text(encoding="utf-8")


def hash_source(text: str) -> str:
    """Return the source expression by which a content security policy allows exactly this text."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def embed_json(value: Any) -> str:
    """Return a value as JSON for a script element."""
    # "</" would end the element.
    return json.dumps(value).replace("</", "<\\/")
