"""``veilface serve``: the REST service."""

import socket
from typing import Annotated

import typer
import uvicorn

from api.app import uvicorn_options
from api.cli.console import demo_notice, message, say
from api.cli.errors import CommandError
from api.cli.options import takes_settings
from api.runtime import Runtime, bootstrap_token
from api.settings import Settings


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(serve)


@takes_settings(*Settings.model_fields)
def serve(
    *,
    settings: Settings,
    check: Annotated[
        bool, typer.Option("--check", help="Open everything, say whether it fits, and stop.")
    ] = False,
) -> None:
    """Start the REST service.

    Needs: a contract file (`veilface calibrate` writes it), and to accept photos also the model
    pack and the decoys file of that contract. The database is created or migrated first. The very
    first start prints an API key with all rights, once: keep it. Stop with Ctrl-C or SIGTERM;
    requests in progress are finished.

    Example: `veilface serve --pack buffalo_l --data-dir veilface-data --workers 2`
    """
    token, demo = _opened_once(settings, check=check)
    if demo and not settings.demo:
        settings = settings.model_copy(update={"demo": True})
    if check:
        say("Everything fits: contract, decoys, pack, database and master key.")
        return
    if token is not None:
        say(f"API key with all rights of tenant {settings.default_tenant}, shown only now:")
        say(token)
    settings = settings.model_copy(update={"port": free_port(settings.host, settings.port)})
    message(f"Veilface listens on http://{settings.host}:{settings.port}")
    try:
        uvicorn.run(**uvicorn_options(settings))
    except SystemExit as error:
        if error.code:
            raise CommandError("the service did not start; its log says why") from None


def _opened_once(settings: Settings, *, check: bool) -> tuple[str | None, bool]:
    """Open everything and let go of it again, models included, before the workers open theirs.

    Returns
    -------
    token : str or None
        The first API key, made now; None where there is one, and for a mere check.
    demo : bool
        Whether the embedder is the demo model.
    """
    runtime = Runtime.open(settings)
    try:
        binding = runtime.contract.binding
        token = None if check else bootstrap_token(runtime.store, settings)
        return token, bool(demo_notice(binding.embedder_sha256, n=binding.n))
    finally:
        runtime.close()


def free_port(host: str, port: int) -> int:
    """Return the port, or a free one for 0.

    Raises
    ------
    CommandError
        The address is taken, or is none of this machine.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
            return int(probe.getsockname()[1])
    except OSError as error:
        raise CommandError(
            f"cannot listen on {host}:{port} ({error.strerror}); choose another --port or --host"
        ) from None
