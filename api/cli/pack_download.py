"""Getting the files of a pack from addresses that the user names."""

import hashlib
import re
import shutil
import tempfile
from pathlib import Path
from typing import IO

import httpx

from api.cli.console import progress
from api.cli.errors import CommandError
from models.archive import MAX_FILE_BYTES, is_archive, unpack

TIMEOUT_S = 30.0
LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})
_GRAPH_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]*\.onnx", re.IGNORECASE)


def shown(source: str) -> str:
    """Write a source without what may be secret in an address: user, password and query."""
    text = source
    if _is_address(source):
        try:
            url = httpx.URL(source)
            text = str(url.copy_with(username=None, password=None, query=None, fragment=None))
        except (httpx.InvalidURL, ValueError):
            text = f"{source.partition(':')[0]}://…"  # where a password stands is not known
    return "".join(c if c.isprintable() else "\ufffd" for c in text)


def obtained(source: str, into: Path, *, sha256: str | None) -> tuple[str, int]:
    """Put the graphs of one source, an archive or a graph, into a folder.

    Returned are the SHA-256 of its bytes, in hex, which must be ``sha256`` if that is given, and
    the number of entries of the archive that are no graphs.
    """
    with tempfile.NamedTemporaryFile(prefix=".draft-", dir=into) as draft:
        if _is_address(source):
            _download(source, draft, is_pinned=sha256 is not None)
        elif Path(source).is_file():
            if Path(source).stat().st_size > MAX_FILE_BYTES:
                raise _too_large(source)
            shutil.copyfile(source, draft.name)
        else:
            raise CommandError(f"{shown(source)} is neither an http(s) address nor a file")
        draft.flush()
        draft.seek(0)
        digest = hashlib.file_digest(draft, "sha256").hexdigest()
        if sha256 is not None and digest != sha256.strip().lower():
            raise CommandError(
                f"{shown(source)} has SHA-256 {digest}, and not the one of --sha256: do not use it"
            )
        if is_archive(Path(draft.name)):
            return digest, unpack(Path(draft.name), into)
        name = Path(httpx.URL(source).path if _is_address(source) else source).name
        if not _GRAPH_NAME.fullmatch(name):
            raise CommandError(
                f"{shown(source)} is neither a zip archive nor an .onnx file with a name of "
                "letters, digits and . _ -"
            )
        if (into / name).exists():
            raise CommandError(f"two sources have a file of the name {name}")
        shutil.copyfile(draft.name, into / name)
        return digest, 0


def _is_address(source: str) -> bool:
    return source.startswith(("http://", "https://"))


def _too_large(source: str) -> CommandError:
    return CommandError(f"{shown(source)} is larger than {MAX_FILE_BYTES:,} bytes: not a pack")


def _download(source: str, draft: IO[bytes], *, is_pinned: bool) -> None:
    try:
        with httpx.stream("GET", source, follow_redirects=True, timeout=TIMEOUT_S) as answer:
            hops = [*(hop.url for hop in answer.history), answer.url]
            if not is_pinned and any(
                url.scheme != "https" and url.host not in LOOPBACK for url in hops
            ):
                raise CommandError(
                    f"{shown(source)} leads over plain http, where anybody on the way may change "
                    "the file: use https, or pin it with --sha256"
                )
            answer.raise_for_status()
            size = answer.headers.get("content-length", "")
            with progress("fetching", int(size) if size.isdecimal() else None) as advance:
                for piece in answer.iter_bytes(2**18):
                    if draft.tell() + len(piece) > MAX_FILE_BYTES:
                        raise _too_large(source)
                    draft.write(piece)
                    advance(len(piece))
    except (httpx.HTTPError, httpx.InvalidURL, ValueError) as error:
        raise CommandError(
            f"{shown(source)} cannot be fetched ({type(error).__name__}): look at it in a browser; "
            "without a network, bring the file here by other means, and name it with --from FILE"
        ) from None
