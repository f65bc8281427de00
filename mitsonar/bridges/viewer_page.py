"""A static page: a recording next to the web viewer of rerun-sdk, for any web server, without network access."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

from mitsonar.errors import MitsonarError
from mitsonar.io.files import write_atomic

__all__ = ["RECORDING", "VIEWER", "write_page"]

RECORDING = "recording.rrd"
VIEWER = ("index.html", "re_viewer.js", "re_viewer_bg.wasm", "favicon.ico")

SERVER_SCRIPT = (
    "import sys, time, rerun; rerun.serve_web_viewer(web_port=int(sys.argv[1]), open_browser=False); time.sleep(600)"
)

NETWORK_BLOCK = """    <meta
      http-equiv="Content-Security-Policy"
      content="default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:"
    />
    <script>
      const load = window.fetch;
      window.fetch = (what, ...how) =>
        new URL(what.url ?? what, window.location).origin === window.location.origin
          ? load(what, ...how)
          : Promise.resolve(new Response("this page loads nothing from elsewhere", { status: 403 }));
    </script>
"""
"""Keeps the viewer from other hosts: it asks one for its newest version and reports its use to another.

The browser enforces the policy. The response 403 keeps the refusals out of the console.
"""

OPEN_RECORDING = f"""    <script>
      const address = new URL(window.location);
      if (!address.searchParams.has("url")) {{
        address.searchParams.set("url", new URL("{RECORDING}", address).href);
        window.history.replaceState(null, "", address);
      }}
    </script>
"""
"""Makes the viewer open the recording next to it: the viewer reads the parameter ``url`` of its address."""

TIMEOUT_S = 60.0


def write_page(folder: Path) -> None:
    """Write the web viewer of the installed rerun-sdk next to ``recording.rrd`` in a folder, and make it open this file.

    The page reaches no other host: neither the fonts nor the viewer's search for updates and its reports of use.
    The viewer is part of the package, and is read from the server that it starts on this machine. A page cannot read
    local files: it needs a web server, such as ``python -m http.server``.

    Raises:
        MitsonarError: the viewer of this rerun-sdk does not answer, or has an unknown form.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    process = subprocess.Popen(
        [sys.executable, "-c", SERVER_SCRIPT, str(port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        files = {name: _fetch(port, name, process) for name in VIEWER}
    finally:
        process.kill()
        process.wait()
    page, head, script = files["index.html"].decode(), "<head>\n", '<script src="re_viewer.js"></script>'
    if page.count(head) != 1 or page.count(script) != 1 or not files["re_viewer_bg.wasm"].startswith(b"\0asm"):
        raise MitsonarError("the web viewer of this rerun-sdk has an unknown form: use --save, and `rerun FILE.rrd`")
    # A page without network must not wait for a font on another host: remove the link, and what is left of its element.
    page = "".join(line for line in page.splitlines(keepends=True) if "fonts.g" not in line)
    page = page.replace('    <link\n      rel="stylesheet"\n    />\n', "").replace(head, head + NETWORK_BLOCK)
    files["index.html"] = page.replace(script, f"{OPEN_RECORDING.strip()}\n    {script}").encode()
    for name, content in files.items():
        write_atomic(folder / name, content)


def _fetch(port: int, name: str, process: subprocess.Popen[bytes]) -> bytes:
    """Read a file from the viewer's own server, which takes a moment to start.

    Raises:
        MitsonarError: it does not answer.
    """
    deadline = time.monotonic() + TIMEOUT_S
    while time.monotonic() < deadline and process.poll() is None:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/{name}", timeout=30) as response:
                return bytes(response.read())
        except urllib.error.HTTPError as error:
            raise MitsonarError(f"this rerun-sdk has no web viewer ({name}: {error.code}): use --save") from None
        except OSError:
            time.sleep(0.1)
    raise MitsonarError("the web viewer of rerun-sdk does not answer: use --save, and open the file with `rerun FILE.rrd`")
