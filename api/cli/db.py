"""``veilface db``: the schema of the database, and its files."""

from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer

from api.cli import flags
from api.cli.errors import UsageError
from api.cli.options import STORE, reports
from api.cli.results import Result, as_json
from api.http.audit import operator
from api.http.receipts import receipt_json
from api.service.opening import checked_store, open_keyring, open_store, retention_of
from api.settings import DEFAULT_TENANT, Settings
from templates.errors import VeilfaceError
from templates.keys.private_file import replace_private
from templates.store.migrate import current_revision, head_revision

app = typer.Typer(no_args_is_help=True)


@app.command()
@reports(*STORE)
def upgrade(*, settings: Settings) -> Result:
    """Migrate the database to the schema of this version.

    `serve` does this when it starts; run it first if several machines start at once.
    Safe to run again. Make a backup, and stop every process of an earlier version first.

    Example: `veilface db upgrade --database-url postgresql+psycopg://veilface@localhost/veilface`
    """
    with closing(open_store(settings, open_keyring(settings))) as store:
        before = current_revision(store.database)
        store.upgrade()
        return Result({"before": before, "after": current_revision(store.database)})


@app.command()
@reports(*STORE)
def check(*, settings: Settings) -> Result:
    """Check that the schema and the master key match; exit status 1 if they do not.

    `current` is the schema that the database is at, and `needed` the one of this version.

    Example: `veilface db check --data-dir veilface-data`
    """
    current, reason = None, None
    with closing(open_store(settings, open_keyring(settings))) as store:
        try:
            current = current_revision(store.database)
            store.check()
        except VeilfaceError as error:
            reason = str(error)
    facts = {"ok": reason is None, "reason": reason, "current": current, "needed": head_revision()}
    return Result(facts, error=reason)


@app.command()
@reports(*STORE)
def compact(*, settings: Settings) -> Result:
    """Rewrite the database files, so that no page keeps erased data.

    On PostgreSQL this is `VACUUM (FULL)` of every table of the store, and needs as much
    free disk; on SQLite, which overwrites erased rows at once, `VACUUM`. Writes wait meanwhile.

    Example: `veilface db compact --data-dir veilface-data`
    """
    with checked_store(settings) as store:
        store.database.compact()
    return Result({"compacted": True})


@app.command()
@reports(*STORE)
def unlock(
    subject: Annotated[str, typer.Argument(help="Subject to unlock.")],
    *,
    settings: Settings,
    tenant: flags.Tenant = DEFAULT_TENANT,
) -> Result:
    """Clear the failed attempts of a subject; exit status 1 if there are none.

    A disabled subject is enabled again. Make sure first that it was the subject who failed.

    Example: `veilface db unlock alice --tenant default`
    """
    with checked_store(settings) as store:
        lifted = store.attempts.reset(tenant, subject, by=operator())
    error = None if lifted else "this subject has no failed attempts"
    return Result({"subject_id": subject, "tenant": tenant, "lifted": lifted}, error=error)


@app.command()
@reports(*STORE, "retention_days", "retention_disuse_days")
def purge(
    *,
    settings: Settings,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Erase nobody.")] = False,
) -> Result:
    """Erase subjects whose retention period has ended, and remove expired records.

    The service does this every ten minutes. Each erased subject leaves a receipt
    and a line in the audit log. Where `log_purged` is no, a reader keeps old pages in SQLite's
    write-ahead log: purge again when it has ended.

    Example: `veilface db purge --retention-days 730 --retention-disuse-days 365 --dry-run`
    """
    retention = retention_of(settings)
    with checked_store(settings) as store:
        due, erased, log_purged = store.erasures.count_due(retention), 0, True
        if not dry_run:
            erased = store.erasures.erase_expired(retention)
            log_purged = store.purge()
    return Result({"due": due, "erased": erased, "log_purged": log_purged})


@app.command("template-enrollment")
@reports(*STORE)
def template_enrollment(
    *,
    settings: Settings,
    tenant: flags.Tenant = DEFAULT_TENANT,
    allow: Annotated[
        bool | None, typer.Option("--allow/--forbid", help="Unset: show the current setting.")
    ] = None,
) -> Result:
    """Allow or forbid a tenant's clients to enroll templates that they made themselves.

    Forbidden by default: with a key for `enroll` and `embeddings` one could enroll a template that
    accepts as many people as it has dimensions. Allow it only if you trust the holders of such keys
    to say who somebody is. It takes effect at once; stored templates stay.

    Example: `veilface db template-enrollment --tenant default --allow`
    """
    with checked_store(settings) as store:
        if allow is not None:
            store.tenants.set_template_enrollment(tenant, allow, by=operator())
        allowed = store.tenants.get(tenant).template_enrollment
    return Result({"tenant": tenant, "template_enrollment": allowed})


@app.command("erase-tenant")
@reports(*STORE)
def erase_tenant(
    tenant: Annotated[str, typer.Argument(help="The tenant's name.")],
    *,
    settings: Settings,
    confirm: Annotated[str, typer.Option(help="The name again, since this cannot be undone.")],
    out: Annotated[Path | None, typer.Option(help="File for the receipt. Unset: stdout.")] = None,
) -> Result:
    """Erase a tenant: its subjects, templates, keys and rotation; write a signed receipt.

    All of it in one transaction, for which other writes wait. Verify the receipt with
    `veilface keys verify-receipt`.

    Example: `veilface db erase-tenant acme --confirm acme --out receipt.json`
    """
    if confirm != tenant:
        raise UsageError("--confirm must repeat the name of the tenant; nothing was erased")
    with checked_store(settings) as store:
        receipt = store.erasures.erase_tenant(tenant, by=operator()).receipt
    answer = receipt_json(receipt)
    if out is not None:
        replace_private(out, as_json(answer).encode())
    return Result(answer, as_json(answer) if out is None else None)
