"""What is written is what a TOML reader reads."""

import tomllib
from pathlib import Path

import pytest

from api.service.settings_file import settings_text


@pytest.mark.parametrize(
    "name", ["plain", 'a "quoted" one', "back\\slash", "tab\tnew\nline", "ü😀\x7f"]
)
def test_any_path_is_read_back_in_full(name: str, tmp_path: Path) -> None:
    folder = tmp_path / name
    text = settings_text(
        {
            "data_dir": folder,
            "demo": True,
            "web_page": False,
            "providers": ("cuda", "cpu"),
            "database_url": f"sqlite:///{name}",
        },
        "Ours.",
    )
    assert text.startswith("# Ours.\n")
    assert tomllib.loads(text) == {
        "data_dir": str(folder),
        "demo": True,
        "web_page": False,
        "providers": ["cuda", "cpu"],
        "database_url": f"sqlite:///{name}",
    }
