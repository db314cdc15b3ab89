"""The files in deploy/: what they set exists, nothing secret gets in; what can be run is run."""

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from api.settings import ENV_PREFIX, Settings
from tests.required import absent

ROOT = Path(__file__).resolve().parent.parent
DEPLOY = ROOT / "deploy"
COMPOSE: dict[str, Any] = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
DOCKERFILE = (DEPLOY / "Dockerfile").read_text()
UNIT = (DEPLOY / "veilface.service").read_text()
# Read by compose.yaml itself, or by commands before there are settings.
IMAGES = {"VEILFACE_BASE_IMAGE", "VEILFACE_POSTGRES_IMAGE", "VEILFACE_REDIS_IMAGE"}
BESIDE_SETTINGS = {"VEILFACE_CONFIG", "VEILFACE_DATA", "VEILFACE_SECRETS", *IMAGES}


@pytest.mark.parametrize("name", ["Dockerfile", "compose.yaml", "veilface.service"])
def test_every_variable_is_a_setting(name: str) -> None:
    known = {f"{ENV_PREFIX}{field}".upper() for field in Settings.model_fields} | BESIDE_SETTINGS
    used = set(re.findall(r"\bVEILFACE_[A-Z_]+\b", (DEPLOY / name).read_text()))
    assert used
    assert used <= known


def test_the_settings_of_the_container_are_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    environment = COMPOSE["services"]["veilface"]["environment"]
    values = {
        key.removeprefix(ENV_PREFIX).lower(): re.sub(r"\$\{\w+:-(.*)\}", r"\1", value)
        for key, value in environment.items()
        if key.startswith(ENV_PREFIX)
    }
    settings = Settings(**values)
    assert settings.workers == 2
    (network,) = COMPOSE["networks"]["default"]["ipam"]["config"]
    assert settings.trusted_proxies == network["gateway"]


def test_the_container_has_no_rights_and_writes_nowhere_else() -> None:
    service = COMPOSE["services"]["veilface"]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert "no-new-privileges:true" in service["security_opt"]
    writable = [volume for volume in service["volumes"] if not volume.endswith(":ro")]
    assert writable == []
    assert all(port.startswith("127.0.0.1:") for port in service["ports"])
    assert re.findall(r"^USER (.*)$", DOCKERFILE, flags=re.M) == ["10001:10001"]


def test_every_secret_is_a_file_that_a_service_uses() -> None:
    used = {name for each in COMPOSE["services"].values() for name in each.get("secrets", [])}
    assert used == set(COMPOSE["secrets"])
    assert all(set(secret) == {"file"} for secret in COMPOSE["secrets"].values())
    text = (DEPLOY / "compose.yaml").read_text()
    assert not re.search(r"PASSWORD:|PASSWORD=|://[^/\s]*:[^/\s@]*@", text)


def test_services_that_are_waited_for_have_a_health_check() -> None:
    services = COMPOSE["services"]
    for name, condition in services["veilface"]["depends_on"].items():
        assert condition == {"condition": "service_healthy"}
        assert "healthcheck" in services[name]
    assert "HEALTHCHECK" in DOCKERFILE


def test_the_image_gets_the_code_and_its_locked_dependencies_only() -> None:
    copied = re.findall(r"^COPY (?!--from)(.+) \S+$", DOCKERFILE, flags=re.M)
    sources = {source for line in copied for source in line.split()}
    ignore = (DEPLOY / "Dockerfile.dockerignore").read_text().split()
    assert ignore[ignore.index("*")] == "*"
    assert sources == {line[1:] for line in ignore if line.startswith("!")}
    packages = re.search(r"^packages = \[(.*)\]$", (ROOT / "pyproject.toml").read_text(), re.M)
    assert packages is not None
    assert set(re.findall(r'"(\w+)"', packages[1])) <= sources
    assert "--require-hashes" in DOCKERFILE


@pytest.fixture
def systemd() -> None:
    """Skip without systemd, or fail where ``VEILFACE_REQUIRE_SYSTEMD=1`` asks for it."""
    if shutil.which("systemd-analyze") is None:
        absent("systemd is not installed", "VEILFACE_REQUIRE_SYSTEMD")


@pytest.mark.usefixtures("systemd")
def test_the_unit_verifies(tmp_path: Path) -> None:
    # The program is not installed here, so another one stands in its place.
    unit = tmp_path / "veilface.service"
    unit.write_text(UNIT.replace("/opt/veilface/bin/veilface", shutil.which("true") or "true"))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(unit)], capture_output=True, text=True
    )
    complaints = [line for line in done.stderr.splitlines() if "veilface.service" in line]
    assert done.returncode == 0
    assert complaints == []


def exposure_is_low(unit: Path) -> bool:
    command = ["systemd-analyze", "security", "--offline=yes", "--threshold=15", "--no-pager"]
    return subprocess.run([*command, str(unit)], capture_output=True).returncode == 0


@pytest.mark.usefixtures("systemd")
def test_the_unit_is_hardened(tmp_path: Path) -> None:
    loose = tmp_path / "loose.service"
    loose.write_text("[Service]\nExecStart=/bin/true\n")
    assert exposure_is_low(DEPLOY / "veilface.service")
    assert not exposure_is_low(loose)
