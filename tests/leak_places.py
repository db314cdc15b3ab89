"""Every byte that a deployment has written: files, rows, relation files, logs, open files."""

import contextlib
import secrets
import stat
from pathlib import Path
from typing import Any

import psycopg

LARGEST_OPEN_FILE = 32 * 1024 * 1024


def files_of(folder: Path) -> dict[str, bytes]:
    """Content of every file below a folder, by its path in it."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def copied_tables(connection: "psycopg.Connection[Any]") -> dict[str, bytes]:
    """Every table as PostgreSQL's binary COPY: all columns, bytes as they are."""
    names = connection.execute(
        "SELECT tablename FROM pg_tables WHERE schemaname = 'public' ORDER BY 1"
    ).fetchall()
    copied = {}
    for (name,) in names:
        with connection.cursor().copy(f'COPY "{name}" TO STDOUT (FORMAT binary)') as copy:
            copied[name] = b"".join(bytes(part) for part in copy)
    return copied


def relation_files(
    connection: "psycopg.Connection[Any]", *, only: str | None = None
) -> dict[str, bytes]:
    """The files of all tables, indexes and TOAST tables, after everything was written to disk."""
    connection.execute("CHECKPOINT")
    tables = connection.execute(
        "SELECT c.relname, pg_relation_filepath(c.oid) FROM pg_class c WHERE c.oid IN ("
        " SELECT unnest(ARRAY[t.oid, t.reltoastrelid]) FROM pg_class t"
        " WHERE t.relnamespace = 'public'::regnamespace AND (%s::text IS NULL OR t.relname = %s))",
        (only, only),
    ).fetchall()
    content = {}
    for name, path in tables:
        row = connection.execute(
            "SELECT pg_read_binary_file(%s, 0, %s, true)", (path, 256 * 1024 * 1024)
        ).fetchone()
        if row is not None and row[0]:
            content[name] = bytes(row[0])
    return content


def log_position(connection: "psycopg.Connection[Any]") -> int:
    """Where the server's log goes on, in bytes since its beginning."""
    row = connection.execute("SELECT pg_current_wal_insert_lsn() - '0/0'::pg_lsn").fetchone()
    assert row is not None
    return int(row[0])


def keep_log(connection: "psycopg.Connection[Any]") -> None:
    """Keep the server from recycling its log for as long as the connection is open."""
    # A server that allows no slots recycles; written_log says so if it has.
    with contextlib.suppress(
        psycopg.errors.InsufficientPrivilege,
        psycopg.errors.ObjectNotInPrerequisiteState,
        psycopg.errors.ConfigurationLimitExceeded,
    ):
        connection.execute(
            "SELECT pg_create_physical_replication_slot(%s, true, true)",
            (f"veilface_leak_{secrets.token_hex(6)}",),
        )


def written_log(connection: "psycopg.Connection[Any]", start: int) -> bytes:
    """What the server wrote to its log since ``start``, to the byte.

    The file of a segment has its full size from the beginning, and is often an old one under a new
    name: behind the last byte written stands what was written long ago, by other runs too.
    """
    connection.execute("CHECKPOINT")  # what was written is in the files, not in memory
    row = connection.execute(
        "SELECT pg_current_wal_flush_lsn() - '0/0'::pg_lsn,"
        " (SELECT setting::bigint FROM pg_settings WHERE name = 'wal_segment_size')"
    ).fetchone()
    assert row is not None
    end, size = int(row[0]), int(row[1])
    parts = []
    for segment in range(start // size * size, end, size):
        first, last = max(start, segment), min(end, segment + size)
        # Older servers count a boundary as the end of the segment before: one byte further in.
        inside = f"{(segment + 1) >> 32:X}/{(segment + 1) & 0xFFFFFFFF:X}"
        content = connection.execute(
            "SELECT pg_read_binary_file('pg_wal/' || pg_walfile_name(%s), %s, %s, true)",
            (inside, first - segment, last - first),
        ).fetchone()
        if content is None or content[0] is None or len(content[0]) != last - first:
            raise AssertionError("the server has recycled a part of its log that must be searched")
        parts.append(bytes(content[0]))
    return b"".join(parts)


def open_files(pid: int) -> dict[str, bytes]:
    """Regular files that the process and its children hold open, unlinked ones too (Linux)."""
    parents = {}
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue
        parents[int(entry.parent.name)] = int(fields[1])
    family, grown = {pid}, True
    while grown:
        more = {child for child, parent in parents.items() if parent in family}
        grown, family = not more <= family, family | more
    open_files = {}
    for member in family:
        for link in Path(f"/proc/{member}/fd").glob("*"):
            try:
                about, target = link.stat(), str(link.readlink())
                if stat.S_ISREG(about.st_mode) and about.st_size <= LARGEST_OPEN_FILE:
                    open_files[target] = link.read_bytes()
            except OSError:
                continue
    return open_files
