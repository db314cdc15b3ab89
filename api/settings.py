"""Settings, declared once: name, default and help.

They come, strongest first, from flags (arguments of :class:`Settings`), from environment
variables ``VEILFACE_*``, and from a TOML file (``VEILFACE_CONFIG``, or ``veilface.toml`` in the
working directory). ``docs/settings.md`` is written from these declarations, and a test keeps it
so.
"""

import os
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator
from pydantic_settings import (
    BaseSettings,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)

from api.errors import StartError

ENV_PREFIX = "VEILFACE_"
CONFIG_VARIABLE = "VEILFACE_CONFIG"
DEFAULT_CONFIG_FILE = Path("veilface.toml")
MIB = 1024 * 1024


def config_file() -> Path | None:
    """Path of the TOML file in force, or None.

    Raises
    ------
    StartError
        If ``VEILFACE_CONFIG`` names a file that does not exist.
    """
    named = os.environ.get(CONFIG_VARIABLE)
    if named:
        path = Path(named)
        if not path.is_file():
            raise StartError(f"{CONFIG_VARIABLE} names {path}, which is not a file")
        return path
    return DEFAULT_CONFIG_FILE if DEFAULT_CONFIG_FILE.is_file() else None


class Settings(BaseSettings):
    """Everything an operator can set. Use :func:`load_settings` to get one sentence on errors."""

    model_config = SettingsConfigDict(
        env_prefix=ENV_PREFIX, extra="forbid", frozen=True, env_ignore_empty=True
    )

    data_dir: Path = Field(
        Path("veilface-data"), description="Folder for everything that Veilface keeps."
    )
    database_url: str | None = Field(
        None,
        description="SQLAlchemy URL of the database: `sqlite:///FILE` or "
        "`postgresql+psycopg://USER:PASSWORD@HOST/NAME`. Unset: `veilface.db` in `data_dir`.",
    )
    master_key_file: Path | None = Field(
        None,
        description="File with the master keys, mode 0600, one a line, the first is current; "
        "created at first use while the database is empty. Unset: `master.key` in `data_dir`. "
        "Without it, nothing that is stored can be read again: keep a copy elsewhere.",
    )
    contract_file: Path | None = Field(
        None,
        description="The contract that `veilface calibrate` wrote. Unset: `contract.json` in "
        "`data_dir`.",
    )
    decoys_file: Path | None = Field(
        None,
        description="The decoy source that `veilface decoys build` wrote; needed to enroll "
        "photos. Unset: `decoys.veil` in `data_dir`, if it is there.",
    )
    pack: Path | None = Field(
        None,
        description="Model pack: a folder of ONNX files, or one embedder file. Unset: the "
        "service accepts templates and embeddings only.",
    )
    providers: Annotated[tuple[str, ...], NoDecode] = Field(
        ("cpu",),
        description="ONNX Runtime providers in order of preference, separated by commas. One "
        "that is absent is an error.",
    )
    onnx_threads: int = Field(
        1, ge=1, le=256, description="Threads that one inference of the pack may use."
    )
    compute_slots: int = Field(
        0,
        ge=0,
        le=1024,
        description="Requests that may compute at the same time in one worker; the others "
        "wait. 0: one for each processor that the "
        "process may use.",
    )
    queue_limit: int = Field(
        32,
        ge=1,
        le=100_000,
        description="Requests with a body that may send it or wait for a compute slot in one "
        "worker; further ones are answered `overloaded`. With `max_request_bytes` it bounds the "
        "memory for bodies.",
    )
    workers: int = Field(1, ge=1, le=256, description="Server processes.")
    host: str = Field("127.0.0.1", description="Address to listen on.")
    port: int = Field(8421, ge=0, le=65535, description="Port to listen on; 0 takes a free one.")
    max_request_bytes: int = Field(
        32 * MIB, ge=1024, le=1024 * MIB, description="Largest request body, in bytes."
    )
    body_timeout_s: float = Field(
        60.0, gt=0, le=3600, description="Seconds that a request body may take to arrive."
    )
    max_image_bytes: int = Field(
        10 * MIB, ge=1024, le=256 * MIB, description="Largest photo, in bytes as sent."
    )
    max_image_pixels: int = Field(
        24_000_000,
        ge=10_000,
        le=400_000_000,
        description="Largest photo, in pixels; checked before decoding, which takes up to 17 "
        "bytes a pixel.",
    )
    max_images: int = Field(10, ge=1, le=10, description="Most photos in one enrollment.")
    default_tenant: str = Field(
        "default",
        pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$",
        description="Tenant of the bootstrap key and of commands that name none.",
    )
    export_key_file: Path | None = Field(
        None,
        description="File with the key for exports, mode 0600. Two deployments that share it "
        "can exchange subjects. Unset: a key kept in the database, which only this deployment "
        "can open.",
    )
    purge_interval_s: float = Field(
        600.0,
        ge=1,
        le=86_400,
        description="Seconds between two rounds in which a worker removes expired records and, "
        "on SQLite, empties the write-ahead log; the first is at the start.",
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="Least severe log line that is written."
    )
    demo: bool = Field(False, description="Say in every answer that the pack is the demo model.")

    @field_validator("providers", mode="before")
    @classmethod
    def _split_providers(cls, value: Any) -> Any:
        if isinstance(value, str):
            value = [part.strip() for part in value.split(",")]
        if isinstance(value, list | tuple):
            names = tuple(value)
            if not names or not all(isinstance(name, str) and name for name in names):
                raise ValueError("name at least one provider, for example cpu")
            return names
        return value

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,  # noqa: ARG003 - the base's signature
        file_secret_settings: PydanticBaseSettingsSource,  # noqa: ARG003
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Order the sources: flags, then the environment, then the TOML file."""
        return (
            init_settings,
            env_settings,
            TomlConfigSettingsSource(settings_cls, toml_file=config_file()),
        )

    @property
    def resolved_database_url(self) -> str:
        """The database, with the default filled in."""
        return self.database_url or f"sqlite:///{(self.data_dir / 'veilface.db').absolute()}"

    @property
    def resolved_master_key_file(self) -> Path:
        """The master key file, with the default filled in."""
        return self.master_key_file or self.data_dir / "master.key"

    @property
    def resolved_contract_file(self) -> Path:
        """The contract file, with the default filled in."""
        return self.contract_file or self.data_dir / "contract.json"

    @property
    def resolved_decoys_file(self) -> Path:
        """The decoy source's file, with the default filled in."""
        return self.decoys_file or self.data_dir / "decoys.veil"

    @property
    def resolved_compute_slots(self) -> int:
        """Compute slots, with the default filled in."""
        return self.compute_slots or processors()


def processors() -> int:
    """Processors that this process may use; a container often may use fewer than there are."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def load_settings(**flags: Any) -> Settings:
    """Read the settings; ``flags`` that are None are taken as not given.

    Raises
    ------
    StartError
        One sentence that names the setting, and what is wrong with it. It never repeats the
        value: a database URL holds a password.
    """
    given = {name: value for name, value in flags.items() if value is not None}
    try:
        return Settings(**given)
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise StartError(f"{config_file()} cannot be read as TOML: {error}") from error
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False, include_context=False)[0]
        name = ".".join(str(part) for part in first["loc"]) or "settings"
        if first["type"] == "extra_forbidden":
            raise StartError(f"unknown setting {name}; docs/settings.md lists them") from None
        raise StartError(f"setting {name}: {first['msg']}") from None


def settings_table() -> str:
    """Write the table of ``docs/settings.md`` from the declarations above."""
    rows = ["| setting | variable | default | meaning |", "|---|---|---|---|"]
    for name, field in Settings.model_fields.items():
        default = field.default
        if isinstance(default, tuple):
            shown = f"`{','.join(default)}`"
        elif default is None:
            shown = ""
        elif isinstance(default, bool):
            shown = f"`{str(default).lower()}`"
        else:
            shown = f"`{default}`"
        rows.append(f"| `{name}` | `{ENV_PREFIX}{name.upper()}` | {shown} | {field.description} |")
    return "\n".join(rows) + "\n"
