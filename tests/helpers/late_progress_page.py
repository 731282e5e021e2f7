"""A page whose work sends progress after it is cancelled; the program prints the page's address."""

import asyncio
import sys

import gradio as gr

from stereoweave.app.events import CancelButton


async def work():
    yield "at work"
    try:
        await asyncio.sleep(60)
    except asyncio.CancelledError:
        yield "late progress"


with gr.Blocks(analytics_enabled=False) as page:
    status, begin = gr.HTML(elem_id="status"), gr.Button("Begin", elem_id="begin")
    cancel = CancelButton("cancel")
    cancel.switch_on([begin.click])
    event = begin.click(work, None, status)
    cancel.connect(status, [event], [event.then])

_, address, _ = page.launch(prevent_thread_lock=True, quiet=True, share=False)
sys.stdout.write(f"{address}\n")
sys.stdout.flush()
page.block_thread()
