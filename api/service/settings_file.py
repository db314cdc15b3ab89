"""Writing ``veilface.toml``, which ``api.settings`` reads."""

from collections.abc import Mapping
from pathlib import Path


def settings_text(values: Mapping[str, Path | bool | tuple[str, ...]], *comments: str) -> str:
    """Write settings as TOML, paths in full, so that the folder of a command does not matter."""
    lines = [f"# {comment}" for comment in comments]
    return "\n".join([*lines, *(f"{name} = {_shown(it)}" for name, it in values.items())]) + "\n"


def _shown(value: Path | bool | tuple[str, ...]) -> str:
    match value:
        case bool():
            return str(value).lower()
        case Path():
            return _quoted(str(value.absolute()))
    return f"[{', '.join(map(_quoted, value))}]"


def _quoted(text: str) -> str:
    return '"' + "".join(map(_escaped, text)) + '"'


def _escaped(character: str) -> str:
    if character in '"\\':
        return f"\\{character}"
    # TOML takes no control character as it is.
    return character if character.isprintable() else f"\\U{ord(character):08x}"
