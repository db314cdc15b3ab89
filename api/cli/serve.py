"""``veilface serve``: the REST service."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer

from api.cli.console import demo_notice, message, say
from api.cli.errors import CommandError
from api.cli.options import takes_settings
from api.cli.verdict import private_mode_weakness, verdict_lines
from api.limits.rates import RateLimits
from api.service.opening import key_beside_database, require_privacy
from api.service.runtime import Runtime
from api.service.server import listen, run_server, tls_options
from api.settings import Settings
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator
from templates.store import TemplateStore


@takes_settings(*Settings.model_fields)
def serve(
    *,
    settings: Settings,
    check: Annotated[
        bool, typer.Option("--check", help="Check that everything fits together, and stop.")
    ] = False,
) -> None:
    """Start the REST service.

    Needs: a contract file (from `veilface calibrate`), and to accept photos also the model pack and
    the decoys file of that contract. The database is created or migrated first. The very first
    start prints an API key with all rights, once: keep it. Stop with Ctrl-C or SIGTERM; requests in
    progress are finished.

    Example: `veilface serve --pack buffalo_l --data-dir veilface-data --workers 2`
    """
    with _ended_by_sigterm():
        contract = _check(settings, first_key=not check)
        binding = contract.binding
        if demo_notice(binding.embedder_sha256, n=binding.n) and not settings.demo:
            settings = settings.model_copy(update={"demo": True})
        if check:
            say("Everything fits together: contract, decoys, pack, database and master key.")
            return
        with listen(settings) as listener:
            port = listener.getsockname()[1]
            message(f"Veilface listens on {service_url(settings, port=port)}")
            try:
                run_server(settings, contract, listener)
            except SystemExit as error:
                if error.code:
                    raise CommandError("the service did not start; its log says why") from None


@contextmanager
def _ended_by_sigterm() -> Iterator[None]:
    """End by SIGTERM, cleaning up, while the server has no handler yet: process 1 ignores it."""
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def service_url(settings: Settings, *, port: int | None = None) -> str:
    """Where the service of some settings answers; ``port`` is the one that was free, for 0."""
    scheme = "http" if settings.tls_certificate is None else "https"
    host = f"[{settings.host}]" if ":" in settings.host else settings.host
    return f"{scheme}://{host}:{port or settings.port}"


def _check(settings: Settings, *, first_key: bool) -> Contract:
    """Open everything, models included, say what an operator should know, and let go of it again.

    The first API key is made and shown where there is none, unless this is a mere check.
    """
    tls_options(settings)
    RateLimits.open(settings)
    runtime = Runtime.open(settings)
    if warning := key_beside_database(settings):
        message(f"warning: {warning}")
    try:
        for line in verdict_lines(runtime.contract.verdict):
            message(line)
        if (weakness := require_privacy(runtime.contract, settings)) is not None:
            message(f"warning: weak privacy is accepted: {weakness}")
        browsers_lift = settings.serve_pack and isinstance(runtime.source, DecoyGenerator)
        if browsers_lift and (weakness := private_mode_weakness(runtime.contract)) is not None:
            message(f"warning: private mode: {weakness}")
        if first_key:
            _show_first_key(runtime.store, settings)
        return runtime.contract
    finally:
        runtime.close()


def _show_first_key(store: TemplateStore, settings: Settings) -> None:
    made = store.api_keys.bootstrap(tenant=settings.default_tenant)
    if made is not None:
        said = f"API key with all rights of tenant {settings.default_tenant}, shown only now:"
        say(f"{said}\n{made.token}")
