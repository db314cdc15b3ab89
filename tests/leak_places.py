"""Every byte that a deployment has written: files, rows, relation files, open files."""

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
