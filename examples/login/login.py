"""Log people in by their face: POST /NAME with a form of `images`. Needs veilface-client."""

import os
import secrets
import unicodedata
from email import message_from_bytes
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote

from veilface_client import Client, Forbidden, LockedOut, ServiceError, Unauthorized, VeilfaceError

CLIENT = Client(os.environ["VEILFACE_URL"], os.environ["VEILFACE_API_KEY"])
SESSIONS: dict[str, str] = {}  # session to name; yours live in a database


def photos_of(content_type: str, body: bytes) -> list[bytes]:
    """Take the photos of a form, and nothing else: it must not choose how it is judged."""
    form = message_from_bytes(f"Content-Type: {content_type}\r\n\r\n".encode() + body)
    return [
        photo
        for part in form.walk()
        if part.get_param("name", header="Content-Disposition") == "images"
        and isinstance(photo := part.get_payload(decode=True), bytes)
    ]


def login(name: str, photos: list[bytes]) -> tuple[int, str]:
    """Return the status of an attempt, and what to tell."""
    try:
        accepted = bool(CLIENT.verify(name, photos))
    except (Unauthorized, Forbidden):  # our key, not their face
        return 502, "use your password"
    except LockedOut as error:
        return error.status, f"too many attempts: locked {lifted(error)}"
    except ServiceError as error:  # no face in the photo, too many requests …
        return error.status, error.message
    except (VeilfaceError, ValueError):
        return 502, "use your password"
    return (204, "") if accepted else (401, "not recognised, try again")


def lifted(error: LockedOut) -> str:
    """Say for how long, and who can end it."""
    if error.details.get("disabled"):
        return "until an administrator lifts it"
    return f"for {error.retry_after or 0:.0f} s; an administrator can lift it"


class Login(BaseHTTPRequestHandler):
    """Answers 204 with a session, 401 for another face, and otherwise what stands in the way."""

    def do_POST(self) -> None:
        """Log in."""
        size = int(self.headers.get("Content-Length", 0))
        name = unicodedata.normalize("NFC", unquote(self.path[1:]))  # as the service reads it
        body = self.rfile.read(size) if 0 < size <= 20_000_000 else b""
        if photos := photos_of(self.headers.get("Content-Type", ""), body):
            status, text = login(name, photos)
        else:
            status, text = 400, "send a form with one to five `images`, of 20 MB together, to /NAME"
        self.send_response(status)
        if status == 204:
            SESSIONS[session := secrets.token_urlsafe(24)] = name
            self.send_header("Set-Cookie", f"session={session}; HttpOnly; Secure; SameSite=Strict")
        self.end_headers()
        self.wfile.write(text.encode())


if __name__ == "__main__":
    port = int(os.environ.get("PORT", "3000"))
    ThreadingHTTPServer(("127.0.0.1", port), Login).serve_forever()
