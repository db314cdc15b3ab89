"""The programs of the clients' pages, which tests run."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = "http://127.0.0.1:8421"
"""Where the service is in them."""


def blocks(page: str, language: str) -> list[str]:
    """The fenced blocks of a page."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)


IN_JAVASCRIPT = blocks("docs/javascript.md", "js")
OF_THE_ELEMENT, OF_THE_CLIENT = (block for block in IN_JAVASCRIPT if "document." in block)
