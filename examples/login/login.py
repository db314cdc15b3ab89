"""Log people in by their face: POST /NAME with a photo as the body. Needs veilface-client."""

import os
import secrets
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from veilface_client import Client, Forbidden, ServiceError, Unauthorized, VeilfaceError

CLIENT = Client(os.environ["VEILFACE_URL"], os.environ["VEILFACE_API_KEY"])
SESSIONS: dict[str, str] = {}  # session to name; yours live in a database


def login(name: str, photo: bytes) -> tuple[int, str]:
    """Return the status of an attempt, and what to tell."""
    try:
        accepted = bool(CLIENT.verify(name, photo))
    except (Unauthorized, Forbidden):  # our key, not their face
        return 502, "use your password"
    except ServiceError as error:  # no face in the photo, locked out …
        return error.status, error.message
    except (VeilfaceError, ValueError):
        return 502, "use your password"
    return (204, "") if accepted else (401, "this is somebody else")


class Login(BaseHTTPRequestHandler):
    """Answers 204 with a session, 401 for another face, and otherwise what stands in the way."""

    def do_POST(self) -> None:
        """Log in."""
        size, name = int(self.headers.get("Content-Length", 0)), self.path[1:]
        if 0 < size <= 10_000_000:
            status, text = login(name, self.rfile.read(size))
        else:
            status, text = 400, "send a photo of at most 10 MB to /NAME"
        self.send_response(status)
        if status == 204:
            SESSIONS[session := secrets.token_urlsafe(24)] = name
            self.send_header("Set-Cookie", f"session={session}; HttpOnly; Secure; SameSite=Strict")
        self.end_headers()
        self.wfile.write(text.encode())


if __name__ == "__main__":
    port = int(os.environ.get("PORT", "3000"))
    ThreadingHTTPServer(("127.0.0.1", port), Login).serve_forever()
