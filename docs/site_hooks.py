"""Hooks of the site's build (mkdocs): pages from files outside docs/, links between them, formulas without a script."""

from __future__ import annotations

import base64
import html
import json
import posixpath
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

__all__ = ["on_files", "on_page_content", "on_page_markdown"]

CellOutput = dict[str, Any]
"""An output of a notebook cell, as the file stores it."""

ROOT = Path(__file__).parent.parent

NOTEBOOKS = ("01_render", "02_dataset", "03_odometry", "04_networks", "05_gradients", "06_bluerov")

PAGES = {
    "benchmarks/README.md": "benchmarks.md",
    "benchmarks/RESULTS.md": "results.md",
    "benchmarks/REPRODUCED.md": "reproduced.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
    **{f"benchmarks/notebooks/{name}.ipynb": f"tutorials/{name}.md" for name in NOTEBOOKS},
}
"""Files of the repository outside docs/ that are pages of the site, and where they are there."""

LINK = re.compile(r"\]\(([^)#\s]+)(#[^)\s]*)?\)")
ROLE = re.compile(r":(?:class|meth|func|attr|data|mod|exc):<code>(?:~[\w.]*?(?=\w+</code>))?([\w.]+)</code>")
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', flags=re.DOTALL)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of :data:`PAGES`."""
    for source, page in PAGES.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=notebook_markdown(source) if source.endswith("ipynb") else text))
    return files


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Lead links between files of the repository to their pages."""
    place = page.file.src_uri
    return relinked(markdown, next((source for source, result in PAGES.items() if result == place), f"docs/{place}"), place)


def on_page_content(content: str, **_: object) -> str:
    """Turn formulas into MathML, which browsers draw without a script, and roles of docstrings into code."""

    def drawn(results: re.Match[str]) -> str:
        return str(convert(html.unescape(results[3]).strip(), display="inline" if results[2] == "(" else "block"))

    return ROLE.sub(r"<code>\1</code>", FORMULA.sub(drawn, content))


def relinked(markdown: str, source: str, place: str) -> str:
    """Return the text with links that hold on the site.

    Args:
        markdown: text of a page.
        source: the file of the repository that it is.
        place: where the page is on the site, below docs/.
    """

    def link(results: re.Match[str]) -> str:
        if "://" in results[1] or results[1].startswith("data:"):
            return results[0]
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), results[1]))
        target = PAGES.get(target, target.removeprefix("docs/"))
        return f"]({posixpath.relpath(target, posixpath.dirname(place) or '.')}{results[2] or ''})"

    return LINK.sub(link, markdown)


def notebook_markdown(source: str) -> str:
    """Return a notebook of the repository as a page: its text, its code, and the results that are stored in it."""
    cells = json.loads((ROOT / source).read_text(encoding="utf-8"))["cells"]
    parts = []
    for number, cell in enumerate(cells):
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
        if not number:
            parts.append(f"This page shows the notebook `{source}`. Run it with Jupyter to change it.")
        parts += [part for output in cell.get("outputs", []) if (part := _result(output))]
    return "\n\n".join(parts)


def _result(output: CellOutput) -> str:
    """Format the output of a cell as Markdown."""
    data = output.get("data", {})
    if "image/png" in data:
        picture = base64.b64encode(base64.b64decode("".join(data["image/png"]))).decode()
        return f"![figure](data:image/png;base64,{picture})"
    if "text/markdown" in data:
        return "".join(data["text/markdown"])
    text = "".join(output.get("text", data.get("text/plain", "")))
    return f"```text\n{text.rstrip()}\n```" if text else ""
