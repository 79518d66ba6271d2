"""A report as a folder: Markdown, its figures, and a single-file page."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from matplotlib.figure import Figure

from outlap.figure_style import save_figure
from outlap.files import atomic_write


class Document:
    """Markdown with tables and figures, and the same as one page that needs no other file."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.blocks: list[str] = []

    def clear(self) -> None:
        """Remove the figures of a report that was here before."""
        for path in (self.folder / "figures").glob("*.*"):
            path.unlink()

    def text(self, *blocks: str) -> None:
        """Add paragraphs or headings."""
        self.blocks += blocks

    def table(self, rows: Iterable[Mapping[str, str]]) -> None:
        """Add a table, unless it has no rows; each row is a text for each heading."""
        rows = list(rows)
        if rows:
            lines = [f"| {' | '.join(cells)} |" for cells in (rows[0], *(row.values() for row in rows))]
            self.blocks.append("\n".join([lines[0], "|" + "---|" * len(rows[0]), *lines[1:]]))

    def figure(self, name: str, figure: Figure) -> None:
        """Save a figure as PNG and SVG, and show it here."""
        for ending in ("png", "svg"):
            save_figure(figure, self.folder / "figures" / f"{name}.{ending}")
        self.blocks.append(f"![{name}](figures/{name}.png)")

    def save(self, title: str) -> None:
        """Write `report.md` and `report.html`."""
        markdown = "\n\n".join(self.blocks) + "\n"
        atomic_write(self.folder / "report.md", markdown)
        atomic_write(self.folder / "report.html", page(markdown, title, self.folder))


def page(markdown: str, title: str, folder: Path) -> str:
    """Markdown as one HTML file, with the figures (their SVG) in it."""
    from markdown_it import MarkdownIt

    body = MarkdownIt("commonmark", {"html": False}).enable("table").render(markdown)

    def inlined(match: re.Match[str]) -> str:
        path = (folder / match[1]).with_suffix(".svg")
        content = base64.b64encode(path.read_bytes()).decode()
        return f'src="data:image/svg+xml;base64,{content}"'

    body = re.sub(r'src="(figures/[^"]+\.png)"', inlined, body)
    body = body.replace("<table>", '<div class="wide"><table>').replace("</table>", "</table></div>")
    return PAGE.format(title=html.escape(title), body=body)


PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
:root {{ color-scheme: light dark; }}
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #222;
  background: #fff; }}
h1 {{ font-size: 1.7rem; }} h2 {{ font-size: 1.25rem; margin-top: 2.4rem; border-bottom: 1px solid #ccc; }}
h3 {{ font-size: 1rem; }}
.wide {{ overflow-x: auto; }}
table {{ border-collapse: collapse; font-size: 0.84rem; font-variant-numeric: tabular-nums; margin: 0.8rem 0; }}
th, td {{ padding: 0.3rem 0.7rem; border-bottom: 1px solid #ddd; text-align: left; white-space: nowrap; }}
th {{ border-bottom: 2px solid #888; white-space: normal; vertical-align: bottom; }}
tbody tr:hover {{ background: #0072b214; }}
img {{ width: min(100%, 50rem); height: auto; background: #fff; }}
code, pre {{ font: 0.85em ui-monospace, monospace; }} pre {{ overflow-x: auto; background: #f4f4f4; padding: 0.8rem; }}
@media (prefers-color-scheme: dark) {{ body {{ color: #ddd; background: #16181b; }} pre {{ background: #24272b; }}
  th, td {{ border-color: #444; }} img {{ padding: 0.4rem; }} }}
</style>
</head>
<body>
{body}
</body>
</html>
"""
