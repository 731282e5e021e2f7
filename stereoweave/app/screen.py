"""Local web page that shows the newest image as a stream of JPEG images.

The headless build of OpenCV has no windows, and a rig often has no screen. Browsers show a stream of JPEG
images (multipart/x-mixed-replace) without a script, even on another machine through a tunnel.
"""

import threading
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import cast
from urllib.parse import urlsplit

import cv2

from stereoweave.errors import StereoweaveError
from stereoweave.pictures.pair_layouts import Picture

_ADDRESS = "127.0.0.1"
# Other names are refused, because another site could point its own name at this address (DNS rebinding).
_HOST_NAMES = (_ADDRESS, "localhost")
# Not "picture", because FFmpeg, a possible client, takes "pict" for the start of a QuickTime file.
_BOUNDARY = "frame"
_PAGE = b"""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>Stereoweave live</title>
<style>
  body { margin: 0; background: #111 }
  img { display: block; width: 100vw; height: 100vh; object-fit: contain }
</style>
<img src="/stream" alt="The left image next to its disparity in colour">
</html>
"""
_JPEG_QUALITY = 85
_REPEAT_S = 0.5


class Screen(ThreadingHTTPServer):
    """Server on the loopback interface that shows the newest image to every visitor.

    Args:
        port: Port number; 0 for any free port.

    Raises:
        StereoweaveError: If the port cannot be opened.
    """

    def __init__(self, port: int) -> None:
        try:
            super().__init__((_ADDRESS, port), _Handler)
        except OSError as error:
            raise StereoweaveError(
                f"expected an available port, found {port} ({error.strerror}); use 0 for any free port",
                setting="port",
            ) from error
        self.url = f"http://{_ADDRESS}:{self.server_port}/"
        self._jpeg, self._number, self._closed = b"", 0, False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self.serve_forever, daemon=True)

    def __enter__(self) -> "Screen":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
        self.shutdown()
        self.server_close()

    def close(self) -> None:
        """End all streams after they have sent the newest image."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def show(self, picture: Picture) -> None:
        """Replace the displayed image with a new RGB image."""
        _, jpeg = cv2.imencode(
            ".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        )
        with self._changed:
            self._jpeg, self._number = jpeg.tobytes(), self._number + 1
            self._changed.notify_all()

    def pictures(self) -> Iterator[bytes]:
        """Yield each new image as JPEG, beginning with the current one; skip images that arrive too fast.

        If no other one follows, an image is yielded twice: Chromium shows an image only when the next one
        arrives.
        """
        shown, is_repeated = 0, True
        while True:
            with self._changed:
                wait_s = None if is_repeated else _REPEAT_S
                # The lambda is called at once.
                self._changed.wait_for(lambda: self._closed or self._number > shown, wait_s)  # noqa: B023
                if self._closed and self._number == shown:
                    return
                is_repeated = self._number == shown
                jpeg, shown = self._jpeg, self._number
            yield jpeg


class _Handler(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        if urlsplit(f"//{self.headers.get('Host', '')}").hostname not in _HOST_NAMES:
            self.send_error(403, "available on this machine only")
        elif self.path == "/":
            self._send_headers("text/html; charset=utf-8")
            self.wfile.write(_PAGE)
        elif self.path == "/stream":
            with suppress(ConnectionError):  # the visitor has left
                self._stream()
        else:
            self.send_error(404)

    def log_message(self, format: str, *values: object) -> None:
        """Log nothing; otherwise, each request would print a line to the terminal."""

    def _send_headers(self, kind: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.end_headers()

    def _stream(self) -> None:
        boundary = f"\r\n--{_BOUNDARY}\r\n".encode()
        self._send_headers(f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
        self.wfile.write(boundary)
        for jpeg in cast(Screen, self.server).pictures():
            header = f"Content-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n".encode()
            # Send the boundary at once, because a browser shows an image only after its final boundary.
            self.wfile.write(header + jpeg + boundary)
