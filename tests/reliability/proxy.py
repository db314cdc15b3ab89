"""nginx, set up by a block of the pages."""

import os
import shutil
from pathlib import Path

import pytest
from cryptography import x509

from tests.api.server_process import ROOT
from tests.certificates import self_signed

PAGE = (ROOT / "docs" / "deploy.md").read_text(encoding="utf-8")
NAME = "faces.example.org"


def require_nginx() -> None:
    """Skip the test without nginx, or fail it where ``VEILFACE_REQUIRE_NGINX=1`` asks for it."""
    if shutil.which("nginx") is None:
        if os.environ.get("VEILFACE_REQUIRE_NGINX") == "1":
            pytest.fail("nginx is not installed, and VEILFACE_REQUIRE_NGINX=1 asks for it")
        pytest.skip("nginx is not installed")


def write_configuration(block: str, folder: Path, listen: str) -> Path:
    """Write a block of the pages as a file of nginx's own, with a certificate for it."""
    certificate, _ = self_signed(folder, host=x509.DNSName(NAME))
    certificate.rename(folder / "chain.pem")
    block = block.replace("/etc/ssl/faces/", f"{folder}/")
    block = block.replace("listen 443 ssl", f"listen {listen} ssl")
    kept = "".join(
        f"{name}_temp_path {folder}/{name};\n"
        for name in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    path = folder / "nginx.conf"
    path.write_text(
        f"pid {folder}/pid;\nerror_log {folder}/error.log;\nevents {{}}\n"
        f"http {{\naccess_log off;\n{kept}{block}}}\n"
    )
    return path
