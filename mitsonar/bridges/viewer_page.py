"""A static page: a recording beside the web viewer that rerun-sdk ships, for any web server and without a network."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

from mitsonar.errors import MitsonarError
from mitsonar.io.files import write_whole

__all__ = ["RECORDING", "VIEWER", "write_page"]

RECORDING = "recording.rrd"
VIEWER = ("index.html", "re_viewer.js", "re_viewer_bg.wasm", "favicon.ico")

SERVE = "import sys, time, rerun; rerun.serve_web_viewer(web_port=int(sys.argv[1]), open_browser=False); time.sleep(600)"

ONLY_HERE = """    <meta
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

The browser holds the policy. The answer 403 keeps the refusals out of the console.
"""

OPEN = f"""    <script>
      const asked = new URL(window.location);
      if (!asked.searchParams.has("url")) {{
        asked.searchParams.set("url", new URL("{RECORDING}", asked).href);
        window.history.replaceState(null, "", asked);
      }}
    </script>
"""
"""Makes the viewer open the recording beside it: the viewer reads the parameter ``url`` of its address."""

LONGEST_S = 60.0


def write_page(folder: Path) -> None:
    """Write the web viewer of the installed rerun-sdk beside ``recording.rrd`` into a folder, and make it open that.

    The page reaches no other host: neither the fonts nor the viewer's search for updates and its reports of use.
    The viewer is inside the package and is read from its own server on this machine. A page cannot read files of a disk:
    it needs a web server, such as ``python -m http.server``.

    Raises:
        MitsonarError: the viewer of this rerun-sdk does not answer, or is not of the form that is known.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
    process = subprocess.Popen(
        [sys.executable, "-c", SERVE, str(port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        files = {name: _fetched(port, name, process) for name in VIEWER}
    finally:
        process.kill()
        process.wait()
    page, head, script = files["index.html"].decode(), "<head>\n", '<script src="re_viewer.js"></script>'
    if page.count(head) != 1 or page.count(script) != 1 or not files["re_viewer_bg.wasm"].startswith(b"\0asm"):
        raise MitsonarError("the web viewer of this rerun-sdk has another form than known: use --save, and `rerun FILE.rrd`")
    # A page without network must not wait for a font on another host: remove the link, and what is left of its element.
    page = "".join(line for line in page.splitlines(keepends=True) if "fonts.g" not in line)
    page = page.replace('    <link\n      rel="stylesheet"\n    />\n', "").replace(head, head + ONLY_HERE)
    files["index.html"] = page.replace(script, f"{OPEN.strip()}\n    {script}").encode()
    for name, content in files.items():
        write_whole(folder / name, content)


def _fetched(port: int, name: str, process: subprocess.Popen[bytes]) -> bytes:
    """Read a file from the viewer's own server, which takes a moment to start.

    Raises:
        MitsonarError: it does not answer.
    """
    end = time.monotonic() + LONGEST_S
    while time.monotonic() < end and process.poll() is None:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/{name}", timeout=30) as answer:
                return bytes(answer.read())
        except urllib.error.HTTPError as error:
            raise MitsonarError(f"this rerun-sdk has no web viewer ({name}: {error.code}): use --save") from None
        except OSError:
            time.sleep(0.1)
    raise MitsonarError("the web viewer of rerun-sdk does not answer: use --save, and open the file with `rerun FILE.rrd`")
