"""``veilface serve``: the REST service."""

import signal
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Annotated

import typer

from api.cli.console import demo_notice, message, say
from api.cli.errors import CommandError
from api.cli.options import STORE, reports
from api.cli.verdict import verdict_lines
from api.limits.rates import RateLimits
from api.service.opening import (
    Deployment,
    key_beside_database,
    open_deployment,
    prepare_database,
)
from api.service.runtime import Runtime
from api.service.server import listen, run_server, tls_options
from api.settings import Settings

FLAGS = (
    *STORE,
    *("pack", "providers", "workers", "host", "port", "tls_certificate", "tls_key"),
    *("rate_limit_storage", "require_private", "liveness", "serve_pack"),
)
"""The settings that one changes by hand; the others come from the environment and the file."""


@reports(*FLAGS)
def serve(
    *,
    settings: Settings,
    check: Annotated[
        bool, typer.Option("--check", help="Check that everything fits together, and stop.")
    ] = False,
) -> None:
    """Start the REST service.

    Needs what `veilface setup` or `calibrate` made, and to accept photos the model pack. The
    database is created or migrated first. API keys come from `setup` or `veilface keys create`.
    Stop with Ctrl-C or SIGTERM; requests in progress are finished.

    Example: `veilface serve --pack buffalo_l --data-dir veilface-data --workers 2`
    """
    # Process 1 ignores SIGTERM while the server has no handler yet.
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    try:
        with _opened(settings, check=check) as deployment:
            if check:
                say("Everything fits together: contract, decoys, pack, database and master key.")
                return
            with listen(settings) as listener:
                port = listener.getsockname()[1]
                message(f"Veilface listens on {service_url(settings, port=port)}")
                try:
                    run_server(deployment, listener)
                except SystemExit as error:
                    if error.code:
                        raise CommandError("the service did not start; its log says why") from None
    finally:
        signal.signal(signal.SIGTERM, before)


def service_url(settings: Settings, *, port: int | None = None) -> str:
    """Where the service of some settings answers; ``port`` is the one that was free, for 0."""
    scheme = "http" if settings.tls_certificate is None else "https"
    host = f"[{settings.host}]" if ":" in settings.host else settings.host
    return f"{scheme}://{host}:{port or settings.port}"


@contextmanager
def _opened(settings: Settings, *, check: bool) -> Iterator[Deployment]:
    """Open what is served for the block, and say what an operator should know of it.

    Several workers open the models themselves, and this process weighs less without any.
    """
    tls_options(settings)
    RateLimits.open(settings)
    answers = check or settings.workers == 1
    deployment = Runtime.open(settings) if answers else open_deployment(settings)
    with closing(deployment):
        prepare_database(deployment.store)
        contract = deployment.contract
        if demo_notice(contract.binding):
            deployment.settings = settings.model_copy(update={"demo": True})
        if warning := key_beside_database(settings):
            message(f"warning: {warning}")
        for line in verdict_lines(contract.verdict):
            message(line)
        if not deployment.store.api_keys.all():
            message("there is no API key yet: `veilface keys create --out FILE` makes one")
        yield deployment
