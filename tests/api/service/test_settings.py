import os
from pathlib import Path

import pytest
from typer.testing import CliRunner

from api.cli import app
from api.http.errors import StartError
from api.settings import Settings, load_settings
from tests.api.deployment import environment_of

OWN_PATHS = ("v1", "health", "docs", "assets", "metrics", "demo")
DOCS = Path(__file__).resolve().parents[3] / "docs"


def settings_table() -> str:
    """The table of ``docs/settings.md``, from the declarations."""
    rows = ["| setting | default | meaning |", "|---|---|---|"]
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
        rows.append(f"| `{name}` | {shown} | {field.description} |")
    return "\n".join(rows) + "\n"


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_table_of_the_documentation_is_the_declaration() -> None:
    assert settings_table() in (DOCS / "settings.md").read_text(encoding="utf-8")


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


def test_defaults_lie_in_the_data_folder_and_the_master_key_beside_it(elsewhere: Path) -> None:
    settings = load_settings(data_dir="here")
    assert settings.resolved_database_url == f"sqlite:///{elsewhere / 'here' / 'veilface.db'}"
    assert settings.resolved_master_key_file == Path("here-keys/master.key")
    assert settings.resolved_contract_file == Path("here/contract.json")
    assert settings.resolved_decoys_file == Path("here/decoys.veil")


def test_a_data_folder_has_one_default_master_key_by_all_its_names(
    elsewhere: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = elsewhere / "here"
    (data / "deeper").mkdir(parents=True)
    (elsewhere / "link").symlink_to("here")
    for name in ("here", "link", data, data / "deeper" / ".."):
        settings = load_settings(data_dir=name)
        assert settings.resolved_master_key_file.absolute() == elsewhere / "here-keys/master.key"
    monkeypatch.chdir(data)
    assert load_settings(data_dir=".").resolved_master_key_file == (
        elsewhere / "here-keys/master.key"
    )


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
        ("providers = ''", "name at least one provider"),
        ("port = ", "cannot be read as TOML"),
        ("rate_limit_key = 'many'", "setting rate_limit_key"),
        ("rate_limit_key = '0/minute'", "at least one"),
        ("rate_limit_address = '5/second;9/minute'", "write one"),
        ("rate_limit_storage = 'memcached://x'", "must be memory:// or begin with"),
        ("trusted_proxies = 'proxy.example'", "setting trusted_proxies"),
        ("tls_key = 'key.pem'", "or neither"),
        ("tls_certificate = 'c.pem'", "or neither"),
        ("lockout_after = 51", "setting lockout_after"),
        ("liveness = 'perhaps'", "setting liveness"),
        ("retention_days = 0", "setting retention_days"),
        *((f"root_path = '/{own}/x'", "a path of the service itself") for own in OWN_PATHS),
        ("root_path = '/a/../b'", "as a step"),
        ("root_path = '/.'", "as a step"),
        ("master_key_variable = 'a-b'", "setting master_key_variable"),
        ("master_key_file = 'k'\nmaster_key_variable = 'K'", "give one of"),
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


@pytest.mark.parametrize(
    "url",
    [
        "postgresql+psycopg://veilface:hunter2@host:54x2/name",
        "postgresql+psycopg://veilface:hunter2@host:99999/name",
        "postgresql+psycopg://veilface:hunter2@host:-1/name",
        "postgresql+psycopg://veilface:hunter2@[::1/name",
        "mysql://veilface:hunter2@host/name",
        "sqlite:///",
        "hunter2",
    ],
)
def test_a_database_url_that_cannot_be_used_is_refused_by_name(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VEILFACE_DATABASE_URL", url)
    ran = CliRunner().invoke(app, ["keys", "list"])
    said = ran.stderr
    assert ran.exit_code == 1
    assert said.startswith("error: setting database_url: ")
    assert "sqlite://" in said
    assert "hunter2" not in said


@pytest.mark.parametrize("given", ["", "off", " off "])
def test_a_limit_may_be_off(given: str) -> None:
    settings = load_settings(rate_limit_key=given, trusted_proxies="")
    assert (settings.rate_limit_key, settings.trusted_proxies) == ("off", "none")


def test_every_kind_of_setting_is_read_from_the_environment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = load_settings(
        port=9,
        providers=("cuda", "cpu"),
        demo=True,
        pack="a/b",
        queue_limit=7,
        tls_certificate="c",
        tls_key="k",
        rate_limit_storage="redis://u:p@h/1",
        retention_days=30,
        master_key_variable="KEYS",
    )
    for name, value in environment_of(settings).items():
        monkeypatch.setenv(name, value)
    assert load_settings() == settings
