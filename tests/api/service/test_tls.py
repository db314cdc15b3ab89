"""TLS, and the health check of the container, which speaks what the service speaks."""

import http.client
import json
import re
import ssl
import subprocess
import sys
from pathlib import Path

import httpx
import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec

from api.http.errors import StartError
from api.service.server import tls_options
from api.settings import Settings, load_settings
from tests.api.deployment import Deployment, bearer, deploy, environment_of
from tests.api.server_process import Server
from tests.certificates import self_signed
from tests.patience import PATIENCE_S
from tests.ports import free_port
from veilface import healthcheck

HEALTHCHECK = Path(__file__).resolve().parents[3] / "deploy/Dockerfile"


def container_says(deployment: Deployment) -> int:
    """Exit status of the Dockerfile's HEALTHCHECK beside a service with these settings."""
    (command,) = re.findall(r"^HEALTHCHECK .*\\\n +CMD (.*)$", HEALTHCHECK.read_text(), re.M)
    python, *arguments = json.loads(command)
    assert python == "python"
    return subprocess.run(
        [sys.executable, *arguments],
        check=False,
        # Where there is a proxy, it is none for the machine itself.
        env={**environment_of(deployment.settings), "http_proxy": "http://127.0.0.1:9"},
    ).returncode


def test_the_health_check_reads_the_settings_as_the_service_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    declared = {name: Settings.model_fields[name].default for name in healthcheck.DEFAULTS}
    assert declared == healthcheck.DEFAULTS
    monkeypatch.chdir(tmp_path)
    (tmp_path / "veilface.toml").write_text('host = "::"\nport = 9\ntls_certificate = "a"\n')
    monkeypatch.setenv("VEILFACE_HOST", "")
    monkeypatch.setenv("VEILFACE_PORT", "10")
    asked = healthcheck.connection()
    assert isinstance(asked, http.client.HTTPSConnection)
    assert (asked.host, asked.port) == ("::1", 10)
    monkeypatch.setenv("VEILFACE_CONFIG", str(tmp_path / "other.toml"))
    (tmp_path / "other.toml").write_text("port = 11\n")
    monkeypatch.delenv("VEILFACE_PORT")
    asked = healthcheck.connection()
    assert not isinstance(asked, http.client.HTTPSConnection)
    assert (asked.host, asked.port) == ("127.0.0.1", 11)


def test_the_service_speaks_tls(tmp_path: Path) -> None:
    certificate, key = self_signed(tmp_path / "tls")
    port = free_port()
    deployment = deploy(tmp_path, port=port, tls_certificate=certificate, tls_key=key)
    url, trust = f"https://127.0.0.1:{port}", ssl.create_default_context(cafile=str(certificate))
    assert container_says(deployment) == 1
    with Server(deployment, tmp_path, verify=trust) as server:
        assert f"listens on {url}" in server.log.read_text()
        answer = httpx.get(
            f"{url}/v1/contract", verify=trust, headers=bearer(deployment.token), timeout=PATIENCE_S
        )
        assert answer.status_code == 200
        assert answer.headers["strict-transport-security"] == "max-age=31536000"
        assert container_says(deployment) == 0
        with pytest.raises(httpx.ConnectError):
            httpx.get(
                f"{url}/health/live", timeout=PATIENCE_S
            )  # nobody vouches for the certificate
        with pytest.raises(httpx.TransportError):
            httpx.get(f"http://127.0.0.1:{port}/health/live", timeout=PATIENCE_S)
        old = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        old.load_verify_locations(certificate)
        old.maximum_version = ssl.TLSVersion.TLSv1_2
        old.set_ciphers("AES128-SHA:AES256-SHA:ECDHE-ECDSA-AES256-SHA")
        with pytest.raises(httpx.ConnectError):
            httpx.get(f"{url}/health/live", verify=old, timeout=PATIENCE_S)
        old.set_ciphers("ECDHE-ECDSA-AES128-GCM-SHA256")
        assert httpx.get(f"{url}/health/live", verify=old, timeout=PATIENCE_S).status_code == 200


def test_a_key_that_others_may_read_is_refused(tmp_path: Path) -> None:
    for mode in (0o640, 0o604, 0o660):
        certificate, key = self_signed(tmp_path, mode=mode)
        with pytest.raises(StartError, match="chmod 600") as caught:
            tls_options(load_settings(tls_certificate=certificate, tls_key=key))
        assert f"{mode:04o}" in str(caught.value)


def test_files_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    certificate, _ = self_signed(tmp_path / "one")
    _, other = self_signed(tmp_path / "other")
    encrypted = tmp_path / "encrypted.pem"
    encrypted.write_bytes(
        ec.generate_private_key(ec.SECP256R1()).private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.BestAvailableEncryption(b"hunter2"),
        )
    )
    encrypted.chmod(0o600)
    for key, sentence in (
        (other, "belong together"),
        (encrypted, "without a password"),
        (tmp_path / "absent", "exist"),
    ):
        with pytest.raises(StartError, match=sentence):
            tls_options(load_settings(tls_certificate=certificate, tls_key=key))
