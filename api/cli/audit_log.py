"""``veilface audit-log``: who did what, and whether the log is whole."""

import json
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import typer

from api.cli import flags
from api.cli.console import progress, say
from api.cli.errors import UsageError
from api.cli.options import STORE, reports
from api.cli.results import Result
from api.cli.store import read_public_key
from api.http.audit import operator
from api.http.schemas import iso_time
from api.service.opening import checked_store
from api.settings import DEFAULT_TENANT, Settings
from templates.keys.private_file import read_bounded
from templates.store import archive_audit_log, verify_audit_log
from templates.store.audit_archive import Archive, verify_archive
from templates.store.audit_chain import Anchor
from templates.store.audit_log import Line
from templates.store.identifiers import InvalidIdentifier

MAX_ANCHOR_BYTES = 4096

app = typer.Typer(no_args_is_help=True)


@app.command()
@reports(*STORE)
def verify(
    *,
    settings: Settings,
    anchor: Annotated[
        str | None,
        typer.Option(help="What `head` wrote earlier, or its file: also finds a log put back."),
    ] = None,
) -> Result:
    """Check the audit log, and keys and lockouts against it; exit status 1 if anything is wrong.

    Names the first line that was altered, removed, added or moved; else what was made up, altered
    or put back of API keys, enrollments, tenants and counts of failed attempts. Lines in an archive
    are not used.

    Example: `veilface audit-log verify --anchor head.txt`
    """
    kept = None if anchor is None else _read_anchor(anchor)
    with (
        checked_store(settings) as store,
        progress("verifying the audit log", None) as advance,
    ):
        report = verify_audit_log(store, anchor=kept, progress=advance)
    problem, records = report.problem, report.records
    what = "records of the database were" if problem is None else "the audit log was"
    return Result(
        {
            "intact": report.intact,
            "lines": report.lines,
            "head": str(report.head),
            "problem": problem and {"sequence": problem.sequence, "problem": problem.what},
            "records": [{"problem": record.what, "about": record.about} for record in records],
        },
        error=None if report.intact else f"{what} tampered with, or damaged",
    )


@app.command()
@reports(*STORE)
def archive(
    file: Annotated[Path, typer.Argument(help="New file for the lines.")],
    *,
    settings: Settings,
    through: Annotated[
        int | None, typer.Option(min=1, help="Number of the last line to move. Unset: all.")
    ] = None,
) -> Result:
    """Move old lines of the audit log into a signed file.

    The lines are verified first, and go from the database once the file is on disk. The log goes on
    where the archive ends. Keep the file: `verify-archive` checks it without the database.

    Example: `veilface audit-log archive audit-2026.jsonl`
    """
    with checked_store(settings) as store:
        return _archived(archive_audit_log(store, file, through=through, by=operator()))


@app.command("verify-archive")
@reports()
def verify_archive_file(
    file: Annotated[Path, typer.Argument(help="What `archive` wrote.")],
    *,
    public_key: flags.PublicKey,
) -> Result:
    """Check an archive's signature and lines; exit status 1 if they are not good.

    Needs no service and no other key. Shows which line the archive follows on, and its last.

    Example: `veilface audit-log verify-archive audit-2026.jsonl --public-key contract.json`
    """
    return _archived(verify_archive(file, read_public_key(public_key)))


def _archived(archived: Archive) -> Result:
    ends = {"base": str(archived.base), "last": str(archived.last)}
    return Result({"lines": archived.lines, **ends})


@app.command()
@reports(*STORE)
def head(*, settings: Settings) -> Result:
    """Print the number and MAC of the last line, to be kept elsewhere.

    Keep it where the database's administrator cannot write: `verify --anchor` then finds a log that
    was put back to an earlier state.

    Example: `veilface audit-log head > head.txt`
    """
    with checked_store(settings) as store:
        last = store.audit_log.head()
    return Result({"sequence": last.sequence, "mac": last.mac.hex()}, str(last))


@app.command()
@reports(*STORE)
def show(
    *,
    settings: Settings,
    subject: Annotated[
        str | None, typer.Option(help="Only lines on this subject, of `--tenant`.")
    ] = None,
    tenant: Annotated[str | None, typer.Option(help="Only lines of this tenant.")] = None,
    after: Annotated[int, typer.Option(min=0, help="Begin after this line.")] = 0,
    limit: Annotated[int | None, typer.Option(min=1, help="At most so many lines.")] = None,
) -> None:
    """Print the lines as JSON, one a line, oldest first. Nothing is verified.

    Subjects appear as pseudonyms; name one with `--subject` to find its lines.

    Example: `veilface audit-log show --subject alice --limit 100`
    """
    with checked_store(settings) as store:
        name = tenant or (DEFAULT_TENANT if subject is not None else None)
        pseudonym = None if subject is None else store.signer.pseudonym(str(name), subject)
        chosen = (
            line
            for line in store.audit_log.lines(after=after)
            if name in (None, line.tenant) and pseudonym in (None, line.pseudonym)
        )
        is_empty = True
        for line in islice(chosen, limit):
            say(json.dumps(_described(line)))
            is_empty = False
        if is_empty and name is not None:
            store.tenants.get(name)  # one that does not exist has no empty log


def _described(line: Line) -> dict[str, Any]:
    names = ("sequence", "tenant", "actor", "action", "outcome", "detail", "request_id")
    facts = {name: getattr(line, name) for name in names}
    return {**facts, "at": iso_time(line.at), "subject": line.pseudonym}


def _read_anchor(text: str) -> Anchor:
    path = Path(text)
    if path.is_file():
        text = read_bounded(path, MAX_ANCHOR_BYTES).decode("ascii", errors="replace")
    try:
        return Anchor.parse(text.strip())
    except InvalidIdentifier:
        raise UsageError(
            "--anchor takes what `veilface audit-log head` wrote, or its file"
        ) from None
