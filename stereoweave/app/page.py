"""The Gradio web page: depth, views and 3-D pictures of an uploaded pair, and videos."""

import gradio as gr

from stereoweave.app.events import LIFETIME_S, Host
from stereoweave.app.pair_tab import PairTab
from stereoweave.app.video_tab import VideoTab

_HEAD = """<div class="head"><h1>Stereoweave</h1>
<p>Two pictures of one scene become depth, 3-D pictures, and the view from anywhere between the two cameras.
The pictures stay on the computer that runs this page.</p></div>"""


def make_page(host: Host) -> gr.Blocks:
    """Make the page's components and event handlers."""
    with gr.Blocks(
        title="Stereoweave", analytics_enabled=False, delete_cache=(LIFETIME_S // 4, LIFETIME_S)
    ) as blocks:
        gr.HTML(_HEAD, padding=False)
        with gr.Tabs():
            with gr.Tab("Pictures"):
                pair_tab = PairTab(host)
            with gr.Tab("Video"):
                video_tab = VideoTab(host)

        def stop_work(request: gr.Request) -> None:
            visitor = str(request.session_hash)
            host.workers.stop(visitor)
            for button in (pair_tab.cancel, video_tab.cancel):
                button.forget(visitor)

        blocks.unload(stop_work)
    return blocks.queue(default_concurrency_limit=1)
