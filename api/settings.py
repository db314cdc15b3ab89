"""Settings, declared once: name, default and help.

They come, strongest first, from flags (arguments of :class:`Settings`), from environment
variables ``VEILFACE_*``, and from a TOML file (``VEILFACE_CONFIG``, or ``veilface.toml`` in the
working directory). A test keeps ``docs/settings.md`` as these declarations are.
"""

import ipaddress
import os
import re
import tomllib
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import limits
from pydantic import BeforeValidator, Field, ValidationError, ValidationInfo, field_validator
from pydantic_settings import (
    BaseSettings,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)

from api.http.errors import StartError
from templates.contract.levels import LEVEL_NAME

ENV_PREFIX = "VEILFACE_"
CONFIG_VARIABLE = "VEILFACE_CONFIG"
DEFAULT_CONFIG_FILE = Path("veilface.toml")
DEFAULT_TENANT = "default"
"""Of the key that `veilface setup` makes, and of commands that name none."""
OFF = "off"
NONE = NO_PROXIES = "none"
_OWN_PATHS = frozenset({"v1", "health", "metrics", "docs", "assets", "demo"})
MAX_ONNX_THREADS = 256

_ORIGIN = re.compile(
    r"(?:https://(?!.*:443$)|http://(?!.*:80$))(?:[a-z0-9.-]+|\[[0-9a-f:]+\])(?::[0-9]{1,5})?"
)


def _parts(value: Any) -> Any:
    """Split a text at its commas; anything else is returned."""
    if not isinstance(value, str):
        return value
    return tuple(part.strip() for part in value.split(",") if part.strip())


def config_file() -> Path | None:
    """Path of the TOML file in force, or None."""
    named = os.environ.get(CONFIG_VARIABLE)
    if not named:
        return DEFAULT_CONFIG_FILE if DEFAULT_CONFIG_FILE.is_file() else None
    if not Path(named).is_file():
        raise StartError(f"{CONFIG_VARIABLE} names {named}, which is not a file")
    return Path(named)


class LivenessPolicy(StrEnum):
    """Which detection of presentation attacks a verification must pass."""

    OFF = "off"
    PASSIVE = "passive"
    ACTIVE = "active"
    BOTH = "both"

    @property
    def passive(self) -> bool:
        """Whether the photos themselves must look live."""
        return self in (LivenessPolicy.PASSIVE, LivenessPolicy.BOTH)

    @property
    def active(self) -> bool:
        """Whether a challenge of head movements must be met."""
        return self in (LivenessPolicy.ACTIVE, LivenessPolicy.BOTH)


class Settings(BaseSettings):
    """Everything an operator can set. Use :func:`load_settings` to get one sentence on errors."""

    model_config = SettingsConfigDict(
        env_prefix=ENV_PREFIX, extra="forbid", frozen=True, env_ignore_empty=True
    )

    data_dir: Path = Field(
        Path("veilface-data"),
        description="Folder of `contract.json`, `decoys.veil`, and an SQLite database.",
    )
    database_url: str | None = Field(
        None,
        description="URL of the database: `sqlite:///FILE` or "
        "`postgresql://USER:PASSWORD@HOST/NAME`. Unset: `veilface.db` in `data_dir`.",
    )
    master_key_file: Path | None = Field(
        None,
        description="File with the master keys, mode 0600, one a line, the first is current; "
        "created at first use. Unset: `master.key` in a folder beside `data_dir`, with `-keys` "
        "after its name. Without it, nothing stored can be read: keep a copy apart.",
    )
    master_key_variable: str | None = Field(
        None,
        pattern=r"^[A-Za-z_][A-Za-z0-9_]*$",
        description="Environment variable that holds the master keys in base64, the first is "
        "current, separated by commas or newlines; instead of `master_key_file`.",
    )
    require_private: bool = Field(
        False,
        description="Refuse to start with a contract whose privacy is not proven.",
    )
    pack: Path | None = Field(
        None,
        description="Model pack: a folder of ONNX files, or one embedder. Unset: no photos.",
    )
    providers: Annotated[tuple[str, ...], NoDecode, BeforeValidator(_parts)] = Field(
        ("cpu",),
        description="ONNX Runtime providers in order of preference, separated by commas.",
    )
    onnx_threads: int = Field(
        1, ge=1, le=MAX_ONNX_THREADS, description="Threads that one inference of the pack may use."
    )
    compute_slots: int = Field(
        0,
        ge=0,
        le=1024,
        description="Requests of one API key that may compute at the same time in one worker, and "
        "half of those of all keys. 0: one for each processor that the process may use.",
    )
    queue_limit: int = Field(
        32,
        ge=1,
        le=100_000,
        description="Requests that may send a body or wait for a slot in one worker; further ones "
        "are answered `overloaded`. One API key gets half of the places at most.",
    )
    workers: int = Field(1, ge=1, le=256, description="Server processes.")
    host: str = Field("127.0.0.1", description="Address to listen on.")
    port: int = Field(8421, ge=0, le=65535, description="Port to listen on; 0 takes a free one.")
    open_metrics: bool = Field(
        False,
        description="Answer `/metrics` to everybody, without an API key.",
    )
    tls_certificate: Path | None = Field(
        None,
        description="PEM file with the certificate chain for TLS. Unset: plain HTTP.",
    )
    tls_key: Path | None = Field(
        None,
        validate_default=True,
        description="PEM file with its private key, without a password, mode 0600.",
    )
    trusted_proxies: str = Field(
        "127.0.0.1",
        description="Addresses or networks of reverse proxies, separated by commas, whose "
        "`X-Forwarded-For` and `X-Forwarded-Proto` are believed; or `none`; or `*` for all: a "
        "client can then choose its address, which defeats the address limit.",
    )
    cors_origins: str = Field(
        NONE,
        description="Origins of web pages that may call `/v1/`, separated by commas, as "
        "`https://HOST` or `https://HOST:PORT`; `*` is refused (docs/rest.md says why).",
    )
    rate_limit_key: str = Field(
        "600/minute",
        description="Requests that one API key may make in any such time, as `COUNT/second`, "
        "`minute`, `hour` or `day`, or `COUNT per 5 minute`; `off`: no limit.",
    )
    rate_limit_address: str = Field(
        "1200/minute",
        description="Requests that one client address (IPv6: one /64 network) may make, in the "
        "same form; counted before the API key is looked up.",
    )
    rate_limit_storage: str = Field(
        "memory://",
        description="Where requests are counted. `memory://`: in each worker for itself, so that "
        "up to `workers` times the limit may pass. `redis://USER:PASSWORD@HOST/NUMBER` or "
        "`rediss://…`: in one place, for all workers and hosts; needs `veilface[redis]`.",
    )
    lowest_level: str | None = Field(
        None,
        pattern=f"^{LEVEL_NAME.pattern}$",
        description="Lowest security level that a verification may ask for (docs/rest.md). Unset: "
        "any. An API key may have a stricter one of its own.",
    )
    liveness: LivenessPolicy = Field(
        LivenessPolicy.OFF,
        description="What every verification must pass as a sign of a living person: `off`, "
        "`passive` (the photos look live), `active` (a challenge of head movements) or `both` "
        "(docs/liveness.md).",
    )
    lockout_after: int = Field(
        5,
        ge=0,
        le=50,
        description="Rejected verifications of one subject in a row after which it is locked for "
        "30 seconds, and twice as long with each further one (docs/rest.md). 0: never.",
    )
    retention_days: int | None = Field(
        None,
        ge=1,
        le=36_500,
        description="Days after its enrollment that a subject is erased. Unset: never.",
    )
    retention_disuse_days: int | None = Field(
        None,
        ge=1,
        le=36_500,
        description="Days after its last accepted verification, or its enrollment, that a subject "
        "is erased. Unset: never.",
    )
    export_key_file: Path | None = Field(
        None,
        description="File with the key for exports, mode 0600, by which deployments can exchange "
        "subjects. Unset: a key of this deployment alone.",
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="Least severe log line that is written."
    )
    root_path: str = Field(
        "",
        pattern=r"^(/[A-Za-z0-9._~-]+)*$",
        description="Path under which a proxy shows the service, such as `/faces` "
        "(docs/deploy.md). The proxy may pass it on or take it away.",
    )
    web_page: bool = Field(
        True,
        description="Serve the web page at `/`, and the reference of the API at `/docs`.",
    )
    serve_pack: bool = Field(
        False,
        description="Give the contract's graphs, at `/v1/pack`, to pages that have a token, "
        "and let the page run them. Mind the licence of the weights (docs/models.md).",
    )
    demo: bool = Field(False, description="Say in every answer that the pack is the demo model.")

    @field_validator("database_url")
    @classmethod
    def _known_database(cls, value: str | None) -> str | None:
        # Imported here: most commands that read settings ask no database.
        from templates.errors import StoreError
        from templates.store.engine import checked_url

        try:
            if value:
                checked_url(value)
        except StoreError as error:
            raise ValueError(str(error)) from None
        return value

    @field_validator("rate_limit_key", "rate_limit_address")
    @classmethod
    def _known_limit(cls, value: str) -> str:
        # Not kept empty: an empty variable counts as unset.
        if value.strip() in ("", OFF):
            return OFF
        try:
            (limit,) = limits.parse_many(value)
        except ValueError:
            limit = None
        if limit is None or limit.amount < 1:
            raise ValueError("write one COUNT/second, minute, hour or day, of at least one, or off")
        return value

    @field_validator("providers")
    @classmethod
    def _some_provider(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if not value:
            raise ValueError("name at least one provider, for example cpu")
        return value

    @field_validator("rate_limit_storage")
    @classmethod
    def _known_storage(cls, value: str) -> str:
        if value != "memory://" and not value.startswith(("redis://", "rediss://")):
            raise ValueError("must be memory:// or begin with redis:// or rediss://")
        return value

    @field_validator("trusted_proxies")
    @classmethod
    def _known_proxies(cls, value: str) -> str:
        names = _parts(value) or (NO_PROXIES,)
        try:
            if names not in (("*",), (NO_PROXIES,)):
                list(map(ipaddress.ip_network, names))
        except ValueError:
            raise ValueError(
                "list IP addresses or networks, separated by commas, or write none or *"
            ) from None
        return ",".join(names)

    @field_validator("root_path")
    @classmethod
    def _no_path_of_ours(cls, value: str) -> str:
        _, *steps = value.split("/")
        if steps and steps[0] in _OWN_PATHS:
            raise ValueError(f"must not begin with a path of the service itself: {steps[0]}")
        if {".", ".."} & set(steps):
            raise ValueError("must not have . or .. as a step, which clients take away")
        return value

    @field_validator("cors_origins")
    @classmethod
    def _known_origins(cls, value: str) -> str:
        origins = _parts(value) or (NONE,)
        if origins != (NONE,) and not all(map(_ORIGIN.fullmatch, origins)):
            raise ValueError(
                "list origins as browsers send them, separated by commas: https://HOST or "
                "https://HOST:PORT, in lower case, without a path, the scheme's own port or *"
            )
        return ",".join(origins)

    @field_validator("tls_key")
    @classmethod
    def _both_of_tls(cls, value: Path | None, info: ValidationInfo) -> Path | None:
        if (value is None) != (info.data.get("tls_certificate") is None):
            raise ValueError("give tls_certificate and tls_key, or neither")
        return value

    @field_validator("master_key_variable")
    @classmethod
    def _one_source_of_keys(cls, value: str | None, info: ValidationInfo) -> str | None:
        if value is not None and info.data.get("master_key_file") is not None:
            raise ValueError("give one of master_key_file and master_key_variable")
        return value

    @classmethod
    def settings_customise_sources(  # type: ignore[override]
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        **_: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Order the sources: flags, then the environment, then the TOML file."""
        file = TomlConfigSettingsSource(settings_cls, toml_file=config_file())
        return init_settings, env_settings, file

    @property
    def resolved_database_url(self) -> str:
        """The database, with the default filled in."""
        return self.database_url or f"sqlite:///{(self.data_dir / 'veilface.db').absolute()}"

    @property
    def resolved_master_key_file(self) -> Path:
        """The master key file, with the default filled in: not where the database is."""
        if self.master_key_file is not None:
            return self.master_key_file
        # A folder has one key, whatever link leads to it.
        plain = self.data_dir.name not in ("", "..") and not self.data_dir.is_symlink()
        data = self.data_dir if plain else self.data_dir.resolve()
        return data.parent / f"{data.name}-keys" / "master.key"

    @property
    def resolved_contract_file(self) -> Path:
        """The contract file, which `veilface calibrate` writes."""
        return self.data_dir / "contract.json"

    @property
    def resolved_decoys_file(self) -> Path:
        """The decoy source's file, which `veilface decoys build` writes."""
        return self.data_dir / "decoys.veil"

    @property
    def allowed_origins(self) -> frozenset[str]:
        """Origins of other pages that may call."""
        return frozenset() if self.cors_origins == NONE else frozenset(self.cors_origins.split(","))

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
    """Read the settings; ``flags`` that are None are taken as not given."""
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
        raise StartError(f"setting {name}: {first['msg'].removeprefix('Value error, ')}") from None
