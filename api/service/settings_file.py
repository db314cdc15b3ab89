"""Writing ``veilface.toml``, which ``api.settings`` reads."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TypeAlias

Value: TypeAlias = Path | str | bool | tuple[str, ...]


def settings_text(values: Mapping[str, Value], *comments: str) -> str:
    """Write settings as TOML, paths in full, so that the folder of a command does not matter."""
    lines = [f"# {comment}" for comment in comments]
    return "\n".join([*lines, *(f"{name} = {_shown(it)}" for name, it in values.items())]) + "\n"


def _shown(value: Value) -> str:
    """Write a value; TOML's strings are JSON's, but TOML takes no DEL as it is."""
    plain = str(value.absolute()) if isinstance(value, Path) else value
    return json.dumps(plain, ensure_ascii=False).replace("\x7f", "\\u007f")
