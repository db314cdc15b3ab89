"""A report as one HTML file: complete in itself, and safe to open whatever names stand in it."""

from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import pytest

from api.cli.html_report import write_html
from verify.evaluation.markdown_cells import plain, table

VOID = {"br", "meta", "hr", "img", "link", "input"}
REFERENCES = {"src", "href", "xlink:href", "data", "action"}


class Page(HTMLParser):
    """Tags that are open, ids, references and text of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: Counter[str] = Counter()
        self.ids: Counter[str] = Counter()
        self.references: set[str] = set()
        self.text = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_startendtag(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] += 1
        for name, value in attrs:
            if name == "id":
                self.ids[value or ""] += 1
            if name in REFERENCES:
                self.references.add(value or "")
            assert not name.startswith("on"), name

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture
def figures(tmp_path: Path) -> list[Path]:
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    from verify.evaluation.figures.style import write

    files = []
    for name in ("det", "roc"):
        figure = Figure(figsize=(2, 2))
        figure.subplots().plot([0, 1], [1, 0], marker="o")
        files += write(figure, tmp_path, name)
    return files


def test_a_report_is_one_file_that_fetches_nothing(tmp_path: Path, figures: list[Path]) -> None:
    hostile = "<script>alert(1)</script> [x](javascript:alert(1)) <img src=//example.org>"
    cells = [[plain(hostile), "1.5<br>2.5"]]
    text = f"# Set {plain(hostile)}\n\n- Seeds: 0\n\n## Rates\n\n"
    text += table(["name", "value"], cells, [True, False]) + "\n\n<script>alert(2)</script>\n"
    captions = {"det": "Errors & rates", "roc": "The other"}
    file = write_html(tmp_path / "results.html", text, figures, captions)
    page = Page(file.read_text(encoding="utf-8"))
    assert page.open == []
    assert page.tags["script"] == page.tags["img"] == page.tags["a"] == page.tags["link"] == 0
    assert (page.tags["svg"], page.tags["table"], page.tags["br"]) == (2, 1, 1)
    assert "alert(1)" in page.text
    assert "alert(2)" in page.text
    assert "Errors & rates" in page.text
    assert set(page.ids.values()) == {1}, "an id of one drawing is met in the other"
    assert {f"#{one}" for one in page.ids} >= page.references
    assert page.references, "the drawings use parts of themselves"


def test_the_clip_of_a_figure_is_its_own(tmp_path: Path, figures: list[Path]) -> None:
    captions = {"det": "One", "roc": "Two"}
    text = write_html(tmp_path / "a.html", "# A\n\n## B\n", figures, captions).read_text()
    first, second = text.index("<svg"), text.rindex("<svg")
    assert "url(#det-" in text[first:second]
    assert "url(#roc-" not in text[first:second]
    assert "url(#roc-" in text[second:]
    assert text.index("</figure>", second) < text.index("<h2>B</h2>")
