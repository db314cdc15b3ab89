"""Flags that commands share: settings, ``--json`` and ``--plan``.

A setting is declared once, in ``api.settings``. A command is a function from flags to a
:class:`Result`; the decorator :func:`reports` gives it a flag for each setting that it names, with
the same help, and the :class:`Settings` that result.
"""

import functools
import inspect
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic.fields import FieldInfo

from api.cli.errors import UsageError
from api.cli.results import Result, present
from api.service.environment import variables_set
from api.settings import CONFIG_VARIABLE, ENV_PREFIX, Settings, load_settings

STORE = ("data_dir", "database_url", "master_key_file", "master_key_variable")

PROCESSOR = "cpu"


def torch_device(device: str) -> str | None:
    """Return a device of torch that this machine has; None for `cpu`."""
    if device == PROCESSOR:
        return None
    # Imported here: a command without the flag starts sooner.
    from templates.distances import require_device

    require_device(device)
    return device


def reports(*settings: str) -> Callable[[Callable[..., Result | None]], Callable[..., None]]:
    """Give a command flags for settings and ``--json``, and show what it returns.

    Its parameter ``settings`` receives what flags, environment and TOML file say. A command that
    returns None has shown everything itself, and takes no ``--json``.
    """

    def decorate(command: Callable[..., Result | None]) -> Callable[..., None]:
        signature = inspect.signature(command)

        def run(*, as_json: bool = False, config: Path | None = None, **given: Any) -> None:
            # A file that is named here wins over the variable, in workers too.
            with variables_set({} if config is None else {CONFIG_VARIABLE: str(config)}):
                if settings:
                    flags = {name: given.pop(name) for name in settings}
                    given["settings"] = load_settings(**flags)
                result = command(**given)
            if result is not None:
                present(result, json=as_json)

        flags = [_flag(name, Settings.model_fields[name]) for name in settings]
        shown = [
            *(each for each in signature.parameters.values() if each.name != "settings"),
            *([_CONFIG, *flags] if settings else []),
            *([] if signature.return_annotation is None else [_AS_JSON]),
        ]
        shown = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in shown]
        functools.update_wrapper(run, command)
        del run.__wrapped__  # type: ignore[attr-defined]
        run.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]
        run.__annotations__ = {each.name: each.annotation for each in shown}
        return run

    return decorate


def _option(name: str, default: Any, kind: Any, *flags: str, **more: Any) -> inspect.Parameter:
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=default,
        annotation=Annotated[kind, typer.Option(*flags, **more)],
    )


_AS_JSON = _option(
    "as_json", False, bool, "--json", help="Write JSON to stdout; messages stay on stderr."
)
_CONFIG = _option(
    "config",
    None,
    Path | None,
    help=f"TOML file with settings. Unset: `{CONFIG_VARIABLE}`, then `veilface.toml`.",
    rich_help_panel="Settings",
)
_KINDS: dict[Any, Any] = {Path | None: Path, int | None: int}
_KINDS |= {kind: kind for kind in (Path, int, float, bool)}


def _flag(name: str, declared: FieldInfo) -> inspect.Parameter:
    default = declared.default
    if isinstance(default, tuple):
        default = ",".join(default)
    shown = "" if default is None else f" Default: `{default}`."
    flag = name.replace("_", "-")
    kind = _KINDS.get(declared.annotation, str)
    return _option(
        name,
        None,
        kind | None,
        f"--{flag}/--no-{flag}" if kind is bool else f"--{flag}",
        help=f"{declared.description}{shown} Variable: `{ENV_PREFIX}{name.upper()}`.",
        rich_help_panel="Settings",
    )


def _read_plan(ctx: typer.Context, file: Path | None) -> Path | None:
    """Take a plan's values as the defaults of the flags that it names."""
    if file is None:
        return None
    try:
        values = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(f"--plan {file} cannot be read as TOML: {error}") from None
    names = {
        flag.lstrip("-"): str(parameter.name)
        for parameter in ctx.command.params
        for flag in (*parameter.opts, str(parameter.name))
        if "--plan" not in parameter.opts
    }
    if unknown := sorted(values.keys() - names.keys()):
        raise UsageError(f"--plan {file} names no option of this command: {', '.join(unknown)}")
    ctx.default_map = {names[name]: value for name, value in values.items()}
    return file


Plan = Annotated[
    Path | None,
    typer.Option(
        "--plan",
        is_eager=True,
        callback=_read_plan,
        help="A TOML file with options, named as their flags; flags that are given win.",
    ),
]
