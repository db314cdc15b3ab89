"""Every reference to a section leads to one that exists.

- ``docs/method.md §4.7``: a numbered section of a page. Further ones follow by "and", "to" or a
  comma.
- ``§4.7`` alone: a section of the page that it stands in.
- ``docs/rest.md "Challenges"``: a heading of a page.
- ``paper §4.3``: the paper that ``docs/method.md`` names.
- ``RFC 9110 §15``, ``NIST SP 800-38D §8.3``, ``ISO/IEC 24745 §6``: other documents; not looked up.
"""

import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAPER = {"1", "2", "3", "3.1", "3.2", "4", "4.1", "4.2", "4.3", "5", "6"}
PAGE = r"(?:docs/)?(?P<page>[\w-]+)\.md"
ELSEWHERE = r"RFC \d+|NIST SP [\w-]+|ISO/IEC [\d:-]+"
SOURCE = rf"{PAGE}|(?P<paper>[Pp]aper)|(?P<elsewhere>{ELSEWHERE})"
REFERENCE = re.compile(
    rf"(?:(?P<source>{SOURCE}) |(?P<further>,? (?:and|to) |, ))?§(?P<number>\d[\d.]*\b|)"
)


def files() -> list[Path]:
    """Sources and pages of the repository, without environments and caches."""
    tops = [path for path in ROOT.iterdir() if not path.name.startswith(".") or path.name == ".ci"]
    below = [path for top in tops if top.is_dir() for path in top.rglob("*")]
    named = [path for path in (*tops, *below) if path.suffix in (".py", ".md")]
    return sorted(path for path in named if path != Path(__file__))


def joined(text: str) -> str:
    """The text in one line, so that a reference may be wrapped, in a comment too."""
    return re.sub(r"\s*\n\s*(?:# ?)?", " ", text)


def headings(page: Path) -> list[str]:
    """Headings of a page, without backticks."""
    lines = page.read_text(encoding="utf-8").splitlines() if page.exists() else []
    return [line.lstrip("#").strip().replace("`", "") for line in lines if line.startswith("#")]


def numbers(page: Path) -> set[str]:
    """Numbers of the sections of a page."""
    found = (re.match(r"(\d+(?:\.\d+)*)\.? ", heading) for heading in headings(page))
    return {number[1] for number in found if number}


def unresolved(text: str, own: Path, docs: Path) -> Iterator[str]:
    """References of a text that lead nowhere; ``own`` is where it stands."""
    text = joined(text)
    source: re.Match[str] | None = None
    end = -1
    for match in REFERENCE.finditer(text):
        # One that only goes on has the source of the one before it.
        if source is None or not match["further"] or end != match.start():
            source = match
        end = match.end()
        number = match["number"].rstrip(".")
        if source["page"]:
            known = number in numbers(docs / f"{source['page']}.md")
        elif source["paper"]:
            known = number in PAPER
        elif source["elsewhere"]:
            known = bool(number)
        else:
            known = number in numbers(own) and own.suffix == ".md"
        if not known:
            yield text[max(0, match.start() - 30) : match.end()]
    for match in re.finditer(r'docs/([\w-]+)\.md "([^"]+)"', text):
        if match[2] not in headings(docs / f"{match[1]}.md"):
            yield match[0]


def test_every_reference_resolves() -> None:
    listed = files()
    assert len(listed) > 300
    wrong = {
        str(path.relative_to(ROOT)): missing
        for path in listed
        if (missing := [*unresolved(path.read_text(encoding="utf-8"), path, ROOT / "docs")])
    }
    assert wrong == {}
