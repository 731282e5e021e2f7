"""A visitor of the page in a browser."""

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from playwright.sync_api import Browser, Download, expect

WINDOW = {"width": 1280, "height": 1000}
# Without compiled kernels in the cache, they are compiled first.
PATIENCE_MS = 60_000


class Visit:
    """One visitor's window; `asked` are the URLs that it requested, `refused` those that failed.

    The window runs `script` before the page's own scripts.
    """

    def __init__(self, browser: Browser, address: str, script: str = "") -> None:
        self.asked: list[str] = []
        self.refused: list[str] = []
        self._context = browser.new_context(viewport=WINDOW)
        self._context.add_init_script(script)
        self.page = self._context.new_page()
        self.page.set_default_timeout(PATIENCE_MS)
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("response", lambda answer: answer.ok or self.refused.append(answer.url))
        self.page.goto(address)
        self.page.locator("#find").wait_for()

    def give(self, **files: Path) -> None:
        """Put files into the fields of these names, and wait until the server has them."""
        for field, file in files.items():
            part = self.page.locator(f"#{field.replace('_', '-')}")
            part.locator("input[type=file]").set_input_files(file)
            part.get_by_label("Clear").wait_for()

    def take_back(self) -> None:
        """Clear the fields for pictures."""
        clear = self.page.get_by_label("Clear").filter(visible=True)
        while before := clear.count():
            clear.first.click()
            expect(clear).not_to_have_count(before)

    def find(self) -> str:
        """Find depth, wait until the notice has changed and all files exist, and return the notice."""
        said = self.page.locator("#status .notice")
        before = said.inner_text() if said.count() else ""
        self.page.click("#find")
        self.page.wait_for_function(
            "before => (document.querySelector('#status .notice')?.innerText ?? before) !== before",
            arg=before,
        )
        if said.get_attribute("role") == "status":
            self.open("Files")
            self.page.locator("#files a").first.wait_for()
            self.open("View")
        return said.inner_text()

    def open(self, tab: str) -> None:
        """Open a tab."""
        self.page.get_by_role("tab", name=tab, exact=True).click()

    def choose(self, field: str, choice: str) -> None:
        """Choose from a drop-down list by the choice's label."""
        self.page.locator(f"#{field} input").click()
        self.page.get_by_role("option", name=choice, exact=True).click()

    def download(self, button: str, folder: Path) -> Path:
        """Press a button that downloads a file, and return the file's path in a folder."""
        with self.page.expect_download() as waiting:
            self.page.click(f"#{button}")
        got: Download = waiting.value
        got.save_as(folder / got.suggested_filename)
        return folder / got.suggested_filename

    def move(self, position: str) -> np.ndarray:
        """Move the slider and return the new view."""
        self.open("View")
        self.page.locator("#position input[type=range]").fill(position)
        self.page.locator("#where").get_by_text(re.compile(f"^{re.escape(position)}, ")).wait_for()
        return self.picture("view")

    def fetch(self, name: str) -> bytes:
        """Return the bytes of the picture that a part of the page shows."""
        shown = self.page.locator(f"#{name} img")
        shown.wait_for()
        answer = self._context.request.get(shown.get_attribute("src"))
        assert answer.ok, (answer.status, answer.url, answer.text())
        return answer.body()

    def picture(self, name: str) -> np.ndarray:
        """Return the RGB image that a part of the page shows."""
        return np.asarray(Image.open(io.BytesIO(self.fetch(name))).convert("RGB"))

    def close(self) -> None:
        self._context.close()


@contextmanager
def visiting(browser: Any, address: str, script: str = "") -> Iterator[Visit]:
    """Open the page in a window of its own, which closes at the end of the block."""
    visit = Visit(browser, address, script)
    yield visit
    visit.close()
