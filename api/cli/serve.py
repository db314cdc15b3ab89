"""``veilface serve``: the REST service."""

import signal
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import Annotated

import typer

from api.cli.console import demo_notice, message, say
from api.cli.errors import CommandError
from api.cli.options import takes_settings
from api.cli.verdict import private_mode_weakness, verdict_lines
from api.limits.rates import RateLimits
from api.service.metrics import shared_directory
from api.service.opening import key_beside_database, require_privacy
from api.service.operations import tls_options
from api.service.runtime import Runtime
from api.service.supervisor import run_server
from api.settings import Settings
from models.sessions import resolve_providers
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
        contract, demo = _opened_once(settings, check=check)
        if demo and not settings.demo:
            settings = settings.model_copy(update={"demo": True})
        if check:
            say("Everything fits together: contract, decoys, pack, database and master key.")
            return
        settings = _with_ports(settings)
        # Workers count together in a folder; a single process counts in its memory.
        counting = nullcontext() if settings.workers == 1 else shared_directory()
        try:
            with counting:
                run_server(settings, contract, on_ready=partial(_say_where, settings))
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


def _say_where(settings: Settings) -> None:
    if settings.operations_port is not None:
        operations = _address(settings.operations_host, settings.operations_port)
        message(f"Health and metrics are on http://{operations}")
    message(f"Veilface listens on {service_url(settings)}")


def service_url(settings: Settings) -> str:
    """Where the service of some settings answers."""
    scheme = "http" if settings.tls_certificate is None else "https"
    return f"{scheme}://{_address(settings.host, settings.port)}"


def _with_ports(settings: Settings) -> Settings:
    """Choose the free ports that are asked for by 0: all workers must open the same."""
    chosen = {"port": free_port(settings.host, settings.port)}
    if settings.operations_port is not None:
        chosen["operations_port"] = free_port(
            settings.operations_host, settings.operations_port, option="operations-"
        )
    return settings.model_copy(update=chosen)


def _address(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _opened_once(settings: Settings, *, check: bool) -> tuple[Contract, bool]:
    """Open everything and let go of it again, models included, before the workers open theirs.

    The first API key is made and shown where there is none, unless this is a mere check.

    Returns
    -------
    contract : Contract
        The one that workers serve.
    demo : bool
        Whether the embedder is the demo model.
    """
    tls_options(settings)
    RateLimits.open(settings)
    if check or settings.workers == 1 or settings.pack is None:
        opened = settings
    else:
        # What an accelerator's library has begun does not survive a fork: it begins in the workers.
        resolve_providers(settings.providers)
        opened = settings.model_copy(update={"providers": ("cpu",)})
    runtime = Runtime.open(opened)
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
        binding = runtime.contract.binding
        if not check:
            _show_first_key(runtime.store, settings)
        return runtime.contract, bool(demo_notice(binding.embedder_sha256, n=binding.n))
    finally:
        runtime.close()


def _show_first_key(store: TemplateStore, settings: Settings) -> None:
    made = store.api_keys.bootstrap(tenant=settings.default_tenant)
    if made is not None:
        said = f"API key with all rights of tenant {settings.default_tenant}, shown only now:"
        say(f"{said}\n{made.token}")


def free_port(host: str, port: int, *, option: str = "") -> int:
    """Return the port, or a free one for 0; ``option`` begins the names of the two options.

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
            f"cannot listen on {host}:{port} ({error.strerror}); choose another "
            f"--{option}port or --{option}host"
        ) from None
