"""A report as one HTML file: the text of its Markdown, with the figures in it."""

import html
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from templates.keys.private_file import replace_public

# Foreign names stand in reports: nothing in the file runs, and nothing is fetched.
_POLICY = "default-src 'none'; style-src 'unsafe-inline'"
_STYLE = """
:root { color-scheme: light dark; --rule: #ccc; --quiet: #f3f3f3; }
@media (prefers-color-scheme: dark) { :root { --rule: #555; --quiet: #262626; } }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 75rem; margin: 0 auto; padding: 1rem; }
h1, h2, h3 { line-height: 1.25; margin: 2em 0 .5em; }
h1 { margin-top: .5em; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .875rem; font-variant-numeric: tabular-nums; }
th, td { border-bottom: 1px solid var(--rule); padding: .3em .7em; vertical-align: top; }
th { background: var(--quiet); text-align: left; }
figure { margin: 1.5em 0; }
figure svg { background: #fff; height: auto; max-width: 100%; }
figcaption { font-size: .875rem; }
code { background: var(--quiet); overflow-wrap: anywhere; padding: 0 .2em; }
@media print {
  :root { color-scheme: light; --rule: #ccc; --quiet: #f3f3f3; }
  body { font-size: 10pt; max-width: none; padding: 0; }
  table { font-size: 7.5pt; }
  .wide { overflow: visible; }
  figure, tr { break-inside: avoid; }
  h2, h3 { break-after: avoid; }
}
"""


def write_html(
    file: Path, markdown: str, figures: Sequence[Path], captions: Mapping[str, str]
) -> Path:
    """Write a report that needs no other file, for the eye and for print; return its file.

    Parameters
    ----------
    markdown
        The report's; its first line is the title. HTML in it is shown as text, but for ``<br>``.
    figures
        Files of the run; the ``.svg`` among them are put before the first section.
    captions
        What a figure shows, by its name without ``.svg``.
    """
    # Imported here: only what ends in a report waits for it.
    from markdown_it import MarkdownIt

    body = MarkdownIt("commonmark", {"html": False}).enable("table").render(markdown)
    body = body.replace("&lt;br&gt;", "<br>")
    body = body.replace("<table>", '<div class="wide" tabindex="0"><table>')
    body = body.replace("</table>", "</table></div>")
    drawn = "".join(
        _figure(path.read_text(encoding="utf-8"), name=path.stem, caption=captions[path.stem])
        for path in figures
        if path.suffix == ".svg"
    )
    head, section, rest = body.partition("<h2>")
    title = html.escape(markdown.partition("\n")[0].lstrip("# "))
    page = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>{_STYLE}</style>\n</head>\n"
        f"<body>\n<main>\n{head}{drawn}{section}{rest}</main>\n</body>\n</html>\n"
    )
    replace_public(file, page.encode())
    return file


def _figure(svg: str, *, name: str, caption: str) -> str:
    """Take a drawing out of its file; its ids get the figure's name, to be unique in the page."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r'\b(id="|xlink:href="#)', rf"\g<1>{name}-", svg).replace("url(#", f"url(#{name}-")
    label = html.escape(caption)
    svg = svg.replace("<svg", f'<svg role="img" aria-label="{label}"', 1)
    return f"<figure>\n{svg}<figcaption>{label}</figcaption>\n</figure>\n"
