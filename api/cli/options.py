"""Options that several commands share, and settings as flags.

A setting is declared once, in ``api.settings``. A command that takes settings names them, and
gets one flag for each with the same help, and the :class:`Settings` that result.
"""

import functools
import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, ParamSpec, TypeVar

import typer
from pydantic.fields import FieldInfo

from api.cli.errors import UsageError
from api.service.environment import variables_set
from api.settings import CONFIG_VARIABLE, ENV_PREFIX, Settings, load_settings
from templates.errors import TemplateError

P = ParamSpec("P")
R = TypeVar("R")

STORE = (
    "data_dir",
    "database_url",
    "master_key_file",
    "master_key_variable",
)
LOCAL = (*STORE, "pack", "providers", "onnx_threads")

AsJson = Annotated[
    bool, typer.Option("--json", help="Write JSON to stdout; messages stay on stderr.")
]
Tenant = Annotated[str, typer.Option(help="Tenant.")]

Device = Annotated[
    str,
    typer.Option(
        help="Where distances in float32 are computed: `cpu`, or a device of torch such as `cuda` "
        "(extra `torch`)."
    ),
]
PROCESSOR = "cpu"
DEFAULT_DIM = 64
"""Dimension that an audit attacks where it is told none."""


def quick(**smaller: Any) -> Any:
    """Make the option ``--quick``: it takes these defaults for options that are not given."""

    def choose(ctx: typer.Context, asked: bool) -> bool:
        if asked:
            ctx.default_map = {**smaller, **(ctx.default_map or {})}
        return asked

    said = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in smaller.items())
    return typer.Option(
        "--quick", is_eager=True, callback=choose, help=f"A first look in minutes: `{said}`."
    )


def chosen_device(device: str) -> str | None:
    """Check that this machine has a device; None for the processor."""
    if device == PROCESSOR:
        return None
    # Imported here: a command without the flag starts sooner.
    from templates.distances import require_device

    try:
        require_device(device)
    except TemplateError as error:
        raise UsageError(f"{error}; leave out --device to use the processor") from None
    return device


def takes_settings(*names: str) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """Give a command a flag for each named setting, and ``--config``.

    The command's parameter ``settings`` receives what flags, environment and TOML file say.
    """

    def decorate(command: Callable[..., R]) -> Callable[..., R]:
        def run(**given: Any) -> R:
            flags = {name: given.pop(name) for name in names}
            with configured_by(given.pop("config")):
                return command(settings=load_settings(**flags), **given)

        flags = [_flag(name, Settings.model_fields[name]) for name in names]
        return shown_as(run, command, _CONFIG, *flags)

    return decorate


def shown_as(
    run: Callable[..., R], command: Callable[..., Any], *added: inspect.Parameter
) -> Callable[..., R]:
    """Let Typer show ``run`` with the parameters of ``command``, but ``settings``, and more."""
    own = [p for p in inspect.signature(command).parameters.values() if p.name != "settings"]
    parameters = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in (*own, *added)]
    functools.update_wrapper(run, command)
    del run.__wrapped__  # type: ignore[attr-defined]
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    return run


@contextmanager
def configured_by(file: Path | None) -> Iterator[None]:
    """Let the TOML file named on the command line win over ``VEILFACE_CONFIG`` in the block."""
    with variables_set({} if file is None else {CONFIG_VARIABLE: str(file)}):
        yield


_CONFIG = inspect.Parameter(
    "config",
    inspect.Parameter.KEYWORD_ONLY,
    default=None,
    annotation=Annotated[
        Path | None,
        typer.Option(
            help=f"TOML file with settings. Unset: `{CONFIG_VARIABLE}`, then `veilface.toml`.",
            rich_help_panel="Settings",
        ),
    ],
)
_KINDS: dict[Any, Any] = {
    Path: Path,
    int: int,
    float: float,
    bool: bool,
    Path | None: Path,
    int | None: int,
}


def _flag(name: str, declared: FieldInfo) -> inspect.Parameter:
    shown = "" if declared.default is None else f" Default: `{_shown(declared.default)}`."
    flag = name.replace("_", "-")
    kind = _KINDS.get(declared.annotation, str)
    option = typer.Option(
        f"--{flag}/--no-{flag}" if kind is bool else f"--{flag}",
        help=f"{declared.description}{shown} Variable: `{ENV_PREFIX}{name.upper()}`.",
        rich_help_panel="Settings",
    )
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=None,
        annotation=Annotated[kind | None, option],
    )


def _shown(value: Any) -> str:
    return ",".join(value) if isinstance(value, tuple) else str(value)
