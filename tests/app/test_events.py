"""Cancelling long work: the work notices at once, and the page says so in the end, whatever arrives late."""

import asyncio
import re
import subprocess
import sys
from pathlib import Path

import pytest
from browsers import chromium
from playwright.sync_api import expect

from stereoweave.app.events import Cancelled, Job

LATE_PROGRESS = Path(__file__).parents[1] / "helpers" / "late_progress_page.py"


def test_work_that_is_cancelled_during_a_look_shows_no_further_progress():
    pressed = []

    async def look():
        job = Job(lambda: bool(pressed))
        job.task = asyncio.create_task(asyncio.sleep(60))
        asyncio.get_running_loop().call_later(0.05, pressed.append, True)
        with pytest.raises(Cancelled):
            await job.is_done()
        job.task.cancel()

    asyncio.run(look())


@pytest.mark.system
@pytest.mark.needs_chromium
def test_progress_that_arrives_after_cancelling_does_not_hide_that_the_work_is_cancelled():
    with subprocess.Popen([sys.executable, LATE_PROGRESS], stdout=subprocess.PIPE, text=True) as server:
        try:
            address = server.stdout.readline().strip()
            with chromium() as browser:
                page = browser.new_page()
                page.goto(address)
                page.click("#begin")
                status = page.locator("#status")
                status.get_by_text("at work").wait_for()
                page.click("#cancel")
                page.locator("#cancel:disabled").wait_for()
                page.wait_for_timeout(1000)  # what is under way arrives
                expect(status).to_have_text(re.compile("^Cancelled"), use_inner_text=True)
        finally:
            server.kill()
