"""``python -P -m veilface.healthcheck``: whether the service that has the same settings is ready.

For the HEALTHCHECK of the container. It takes the environment and the TOML file as the service
does, so that it asks the right port, and speaks TLS where the service does. What `serve` was given
as flags it cannot know. It imports nothing but the standard library: it is started every few
seconds, and the settings' own module takes a second of a processor.
"""

import http.client
import os
import ssl
import sys
import tomllib
from pathlib import Path
from typing import Any

TIMEOUT_S = 4.0
DEFAULTS: dict[str, Any] = {
    "host": "127.0.0.1",
    "port": 8421,
    "tls_certificate": None,
}
"""Of :class:`api.settings.Settings`."""
EVERY_ADDRESS = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # noqa: S104 - not opened


def settings() -> dict[str, Any]:
    """Read what says where the service answers."""
    try:
        with Path(os.environ.get("VEILFACE_CONFIG") or "veilface.toml").open("rb") as file:
            written = tomllib.load(file)
    except FileNotFoundError:
        written = {}
    return {
        name: os.environ.get(f"VEILFACE_{name.upper()}") or written.get(name, default)
        for name, default in DEFAULTS.items()
    }


def connection() -> http.client.HTTPConnection:
    """Return a connection, not yet open, to the port that answers ``/health/ready``.

    No proxy of the environment is asked, and the certificate is not checked: it is for another
    name, and this machine is asked about itself.
    """
    known = settings()
    host, port = EVERY_ADDRESS.get(known["host"], known["host"]), known["port"]
    if known["tls_certificate"] is None:
        return http.client.HTTPConnection(host, int(port), timeout=TIMEOUT_S)
    unchecked = ssl._create_unverified_context()  # noqa: S323 - see above
    return http.client.HTTPSConnection(host, int(port), timeout=TIMEOUT_S, context=unchecked)


def main() -> int:
    """Ask once; return the exit status, 0 if it is ready."""
    try:
        asked = connection()
        asked.request("GET", "/health/ready")
        status = asked.getresponse().status
    except (OSError, ValueError, http.client.HTTPException) as error:
        print(f"not ready: {type(error).__name__}", file=sys.stderr)  # noqa: T201
        return 1
    if status != http.client.OK:
        print(f"not ready: it answers {status}", file=sys.stderr)  # noqa: T201
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
