import os
from pathlib import Path

import pytest

from api.app import environment_of
from api.errors import StartError
from api.settings import Settings, load_settings, settings_table

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_table_of_the_documentation_is_the_declaration() -> None:
    assert settings_table() in (DOCS / "settings.md").read_text(encoding="utf-8")


def test_every_setting_has_a_help_text() -> None:
    assert [name for name, field in Settings.model_fields.items() if not field.description] == []


def test_flags_win_over_environment_over_file(
    elsewhere: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (elsewhere / "veilface.toml").write_text("port = 1001\nworkers = 2\nhost = '0.0.0.0'\n")
    monkeypatch.setenv("VEILFACE_PORT", "1002")
    monkeypatch.setenv("VEILFACE_WORKERS", "3")
    settings = load_settings(port=1003, workers=None)
    assert (settings.port, settings.workers, settings.host) == (1003, 3, "0.0.0.0")


def test_config_variable_names_another_file(
    elsewhere: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (elsewhere / "other.toml").write_text("providers = ['cuda', 'cpu']\n")
    monkeypatch.setenv("VEILFACE_CONFIG", "other.toml")
    assert load_settings().providers == ("cuda", "cpu")
    monkeypatch.setenv("VEILFACE_CONFIG", "absent.toml")
    with pytest.raises(StartError, match=r"absent\.toml"):
        load_settings()


def test_defaults_lie_in_the_data_folder(elsewhere: Path) -> None:
    settings = load_settings(data_dir="here")
    assert settings.resolved_database_url == f"sqlite:///{elsewhere / 'here' / 'veilface.db'}"
    assert settings.resolved_master_key_file == Path("here/master.key")
    assert settings.resolved_contract_file == Path("here/contract.json")
    assert settings.resolved_decoys_file == Path("here/decoys.veil")


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="the system has no affinity")
def test_a_slot_for_each_processor_that_the_process_may_use(
    elsewhere: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {2, 5, 7})
    monkeypatch.setattr("os.cpu_count", lambda: 64)
    assert load_settings().resolved_compute_slots == 3
    assert load_settings(compute_slots=9).resolved_compute_slots == 9


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("prot = 1", "unknown setting prot"),
        ("port = 'many'", "setting port"),
        ("port = 70000", "setting port"),
        ("providers = ''", "setting providers"),
        ("default_tenant = 'a b'", "setting default_tenant"),
        ("port = ", "cannot be read as TOML"),
    ],
)
def test_a_wrong_file_is_one_sentence(elsewhere: Path, text: str, sentence: str) -> None:
    (elsewhere / "veilface.toml").write_text(text)
    with pytest.raises(StartError, match=sentence) as caught:
        load_settings()
    assert "\n" not in str(caught.value)


def test_an_error_never_repeats_a_value(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VEILFACE_PORT", "hunter2")
    with pytest.raises(StartError) as caught:
        load_settings()
    assert "hunter2" not in str(caught.value)


def test_settings_travel_to_workers_in_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = load_settings(
        port=9, providers=("cuda", "cpu"), demo=True, pack="a/b", queue_limit=7, body_timeout_s=1.5
    )
    for name, value in environment_of(settings).items():
        monkeypatch.setenv(name, value)
    assert load_settings() == settings
