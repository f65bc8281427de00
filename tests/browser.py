"""A page in headless Chromium by its DevTools protocol: what it requests, what its console says, what it looks like."""

from __future__ import annotations

import base64
import io
import json
import shutil
import subprocess
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from websockets.sync.client import ClientConnection, connect

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
"""The browser, or None."""

OPTIONS = (
    *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run", "--remote-debugging-port=0"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),  # WebGL without a GPU
)


class Quiet(SimpleHTTPRequestHandler):
    """What `python -m http.server` runs, without its log."""

    def log_message(self, *_: object) -> None:
        """Say nothing."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder on this machine; gives the address."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class Page:
    """A page of the browser, and all that it has reported."""

    def __init__(self, link: ClientConnection) -> None:
        """Ask for reports of network and console."""
        self.link, self.asked = link, 0
        self.requested: list[str] = []
        self.status: dict[str, int] = {}
        self.said: list[tuple[str, str]] = []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{domain}.enable")

    def ask(self, method: str, **parameters: Any) -> Any:
        """Send a command and wait for its answer."""
        self.asked += 1
        self.link.send(json.dumps({"id": self.asked, "method": method, "params": parameters}))
        end = time.monotonic() + 60
        while time.monotonic() < end:
            got = json.loads(self.link.recv(timeout=60))
            if got.get("id") == self.asked:
                assert "error" not in got, got
                return got["result"]
            self._note(got["method"], got["params"])
        raise TimeoutError(method)

    def wait(self, seconds: float) -> None:
        """Note what is reported for some time."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            try:
                got = json.loads(self.link.recv(timeout=left))
            except TimeoutError:
                return
            self._note(got["method"], got["params"])

    def _note(self, event: str, told: dict[str, Any]) -> None:
        if event == "Network.requestWillBeSent":
            self.requested.append(told["request"]["url"])
        elif event == "Network.responseReceived":
            self.status[told["response"]["url"]] = told["response"]["status"]
        elif event == "Runtime.consoleAPICalled":
            self.said.append((told["type"], " ".join(str(one.get("value", one)) for one in told["args"])))
        elif event == "Runtime.exceptionThrown":
            self.said.append(("error", json.dumps(told["exceptionDetails"])))
        elif event == "Log.entryAdded":
            self.said.append((told["entry"]["level"], told["entry"]["text"]))

    def screenshot(self) -> NDArray[np.uint8]:
        """The page as ``(rows, columns, 3)``."""
        png = base64.b64decode(self.ask("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))

    def run(self, script: str) -> Any:
        """What a script in the page gives; a promise is awaited."""
        return self.ask("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)["result"].get("value")


@contextmanager
def opened(address: str, profile: Path, width: int, height: int) -> Iterator[Page]:
    """Open a page in a browser of its own, whose profile is a new folder."""
    assert CHROMIUM is not None
    words = [CHROMIUM, *OPTIONS, f"--user-data-dir={profile}", f"--window-size={width},{height}", "about:blank"]
    browser = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        port = _port_of(profile, browser)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=30) as answer:
            tab = next(one for one in json.load(answer) if one["type"] == "page")
        with connect(tab["webSocketDebuggerUrl"], max_size=None) as link:
            page = Page(link)
            page.ask("Page.navigate", url=address)
            yield page
    finally:
        browser.kill()
        browser.wait()


def _port_of(profile: Path, browser: subprocess.Popen[bytes]) -> int:
    """The browser writes its port into its profile."""
    end = time.monotonic() + 60
    while time.monotonic() < end and browser.poll() is None:
        message = profile / "DevToolsActivePort"
        if message.is_file() and (words := message.read_text().split()):
            return int(words[0])
        time.sleep(0.1)
    raise TimeoutError(f"the browser does not answer; it ended with {browser.poll()}")
