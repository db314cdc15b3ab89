"""What ``veilface setup`` leaves beside decoys and contract: an API key, and the settings."""

import tomllib
from pathlib import Path
from typing import Any

from api.cli.console import message
from api.cli.master_keys import is_from_file, opened_store
from api.http.audit import operator
from api.service.settings_file import settings_text
from api.settings import DEFAULT_CONFIG_FILE, Settings, config_file, load_settings
from templates.keys.private_file import create_private, replace_private, replace_public
from templates.keys.sealing import MasterKeyring
from templates.store import TemplateStore
from templates.store.api_keys import ApiKey, Right
from templates.store.identifiers import utc_now

RIGHTS = (Right.ENROLL, Right.VERIFY, Right.ERASE)
KEY_LABEL = "setup"
HEADER = "Written by `veilface setup`; docs/settings.md has the rest."
_MAX_TOKEN_FILE_BYTES = 4096


def report_step(made: dict[str, str], step: str, file: Path) -> bool:
    """Say whether a step's file is there and kept, or is made now; the former is returned."""
    kept = file.exists()
    made[step] = "kept" if kept else "made"
    message(f"... {step}: {f'{file} is there and kept' if kept else f'making {file}'}")
    return kept


def report_master_key(made: dict[str, str], settings: Settings) -> None:
    """Say where the master key comes from; only a file is ever made."""
    if is_from_file(settings):
        report_step(made, "master key", settings.resolved_master_key_file)
        return
    made["master key"] = "given"
    message(f"... master key: {master_key_source(settings)}, no file is made")


def master_key_source(settings: Settings) -> str:
    """Name the place that the master key comes from."""
    if settings.master_key_variable is not None:
        return f"of the variable {settings.master_key_variable}"
    return str(settings.resolved_master_key_file)


def api_key_file(settings: Settings) -> Path:
    """Where the API key is kept: with the master key, not with the data."""
    return settings.resolved_master_key_file.parent / "api-key"


def keep_api_key(settings: Settings, keyring: MasterKeyring, made: dict[str, str]) -> ApiKey:
    """See to it that the file holds a key that the store takes, readable by its owner only.

    A key that was made and got into no file, because the run was killed between, is revoked: it is
    one of ours that never signed in, as every key does here once it is written.
    """
    file, step = api_key_file(settings), "API key"
    with opened_store(settings, keyring) as store:
        is_there = file.exists()
        key = _signed_in(store, file) if is_there else None
        if key is not None:
            report_step(made, step, file)
        else:
            made[step] = "made"
            why = f"the store does not take the one of {file}: making another" if is_there else ""
            message(f"... {step}: {why or f'making {file}'}")
            store.tenants.create(settings.default_tenant)
            new = store.api_keys.create(
                settings.default_tenant, RIGHTS, label=KEY_LABEL, by=operator()
            )
            write = replace_private if is_there else create_private
            write(file, f"{new.token}\n".encode())
            key = _signed_in(store, file) or new.key
        _revoke_unwritten(store, settings, key)
    return key


def _signed_in(store: TemplateStore, file: Path) -> ApiKey | None:
    with file.open("rb") as opened:
        token = opened.read(_MAX_TOKEN_FILE_BYTES).decode("ascii", "replace").strip()
    return store.api_keys.verify(token)


def _revoke_unwritten(store: TemplateStore, settings: Settings, key: ApiKey) -> None:
    now = utc_now()
    for other in store.api_keys.all(tenant=settings.default_tenant):
        is_ours = other.label == KEY_LABEL and other.last_used_at is None
        if is_ours and other.prefix != key.prefix and other.is_valid_at(now):
            store.api_keys.revoke(other.prefix, by=operator())
            message(f"note: revoked the API key {other.prefix}, which a stopped run had made")


def write_settings(settings: Settings, made: dict[str, str]) -> str | None:
    """Write the settings; a file that is not ours is kept.

    Returns
    -------
    str or None
        What is wrong where that file would have another service started; None where all is well.
    """
    values: dict[str, Any] = {"data_dir": settings.data_dir, "pack": settings.pack}
    if settings.master_key_file is not None:
        values["master_key_file"] = settings.master_key_file
    if settings.providers != Settings.model_fields["providers"].default:
        values["providers"] = settings.providers
    if settings.accept_weak_privacy:
        values["accept_weak_privacy"] = True
    file, wanted = config_file() or DEFAULT_CONFIG_FILE, settings_text(values, HEADER)
    present = file.read_text(encoding="utf-8") if file.is_file() else None
    made["settings"] = "kept"
    if present is None or (present != wanted and _is_ours(present)):
        made["settings"] = "made"
        replace_public(file, wanted.encode())
        message(f"... settings: {file} written")
        return None
    message(f"... settings: {file} is there and kept")
    if present == wanted:
        return None
    served = load_settings()
    other = [name for name in values if _in_full(served, name) != _in_full(settings, name)]
    if not other:
        return None
    return (
        f"{file} is not of this command and was kept, and says something else of "
        f"{', '.join(other)}, so that `veilface serve` would not start what was set up here; "
        f"it should say\n{wanted}"
    )


def _is_ours(text: str) -> bool:
    """Whether this command wrote a file, and nobody added a setting."""
    written = {"data_dir", "pack", "master_key_file", "providers", "accept_weak_privacy"}
    return text.startswith(f"# {HEADER}\n") and set(tomllib.loads(text)) <= written


def _in_full(settings: Settings, name: str) -> Any:
    value = getattr(settings, name)
    return value.absolute() if isinstance(value, Path) else value
