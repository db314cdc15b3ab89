import os

import pytest
import typer
from typer.testing import CliRunner

from api.cli.errors import Commands
from api.cli.options import takes_settings
from api.settings import CONFIG_VARIABLE, Settings


def shown(*names: str) -> typer.Typer:
    """An app whose one command says which settings reached it."""
    app = typer.Typer(cls=Commands, pretty_exceptions_enable=False)

    @app.command()
    @takes_settings(*names)
    def show(word: str, *, settings: Settings) -> None:
        typer.echo(f"{word} {settings.data_dir} {settings.port} {settings.providers}")
        typer.echo(os.environ.get(CONFIG_VARIABLE, "-"))

    @app.command()
    def other() -> None:
        """So that there is a group."""

    return app


@pytest.fixture(autouse=True)
def no_other_settings(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in [name for name in os.environ if name.startswith("VEILFACE_")]:
        monkeypatch.delenv(name)


def ran(*arguments: str, names=("data_dir", "port", "providers")):
    return CliRunner().invoke(shown(*names), ["show", "hello", *arguments])


def test_a_flag_wins_over_the_environment_and_that_over_the_file(tmp_path, monkeypatch):
    file = tmp_path / "mine.toml"
    file.write_text('data_dir = "from-file"\nport = 1111\nproviders = "cpu,cuda"\n')
    monkeypatch.setenv("VEILFACE_PORT", "2222")
    result = ran("--config", str(file), "--data-dir", "from-flag")
    assert result.stdout.splitlines()[0] == "hello from-flag 2222 ('cpu', 'cuda')"


def test_the_file_is_known_to_workers_and_forgotten_afterwards(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text("port = 1111\n")
    result = ran("--config", str(file))
    assert result.stdout.splitlines()[1] == str(file)
    assert CONFIG_VARIABLE not in os.environ


def test_a_wrong_setting_is_one_sentence(tmp_path):
    result = ran("--port", "99999")
    assert result.exit_code == 1
    assert "error: setting port:" in result.stderr
    absent = ran("--config", str(tmp_path / "absent.toml"))
    assert absent.exit_code == 1
    assert "is not a file" in absent.stderr
