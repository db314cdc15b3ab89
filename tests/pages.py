"""The pages of the documentation, and the blocks in them."""

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FENCED = re.compile(r"^( *)```.*?^\1```", flags=re.M | re.S)


@dataclass(frozen=True)
class Snippet:
    """A block of a page: where it begins, its language, its text."""

    page: str
    line: int
    kind: str
    code: str

    @property
    def where(self) -> str:
        return f"{self.page}:{self.line}"


def pages(root: Path) -> list[Path]:
    return [*sorted(root.glob("*.md")), *sorted((root / "docs").glob("*.md"))]


def snippets(root: Path) -> list[Snippet]:
    """Return every fenced block below a folder."""
    blocks = []
    for path in pages(root):
        text = path.read_text(encoding="utf-8")
        for block in FENCED.finditer(text):
            opening, *lines = block[0].split("\n")[:-1]
            code = "\n".join(line.removeprefix(block[1]) for line in lines) + "\n"
            line = text.count("\n", 0, block.start()) + 1
            page = path.relative_to(root).as_posix()
            blocks.append(Snippet(page, line, opening.strip(" `"), code))
    return blocks
