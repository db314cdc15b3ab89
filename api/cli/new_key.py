"""A new API key is shown once; one that cannot be shown is revoked."""

import typer

from api.cli.errors import CommandError
from api.http.audit import operator
from templates.store import TemplateStore
from templates.store.api_keys import NewApiKey


def show_once(store: TemplateStore, made: NewApiKey, text: str) -> None:
    """Write a text with the new token to stdout.

    Raises
    ------
    CommandError
        Nobody has it, since the reader is gone or the disk is full. The key is revoked.
    """
    try:
        typer.echo(text)
    except OSError as error:
        store.api_keys.revoke(made.key.prefix, by=operator())
        raise CommandError(
            f"the new key {made.key.prefix} could not be written ({error.strerror}), and is "
            "revoked: make another with `veilface keys create`"
        ) from None
