"""Chromium's virtual authenticators, and the holder key as the documentation derives it."""

import base64
import hashlib
from dataclasses import dataclass

from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF
from playwright.sync_api import CDPSession, Page

LABEL = "Veilface holder key 1: "
EVALUATE = """
async (salt) => {
  const used = await navigator.credentials.get({
    publicKey: {
      challenge: new Uint8Array(32),
      userVerification: "required",
      extensions: { prf: { eval: { first: new Uint8Array(salt) } } },
    },
  });
  return [...new Uint8Array(used.getClientExtensionResults().prf.results.first)];
}
"""


@dataclass
class Authenticator:
    """The one authenticator of a tab; it can be exchanged for another."""

    page: Page
    session: CDPSession
    name: str = ""

    @classmethod
    def of(cls, page: Page) -> "Authenticator":
        """Give a tab an authenticator that has PRF, and a visitor who says yes."""
        made = cls(page, page.context.new_cdp_session(page))
        made.session.send("WebAuthn.enable")
        made.exchange()
        return made

    def exchange(self, *, prf: bool = True, answers: bool = True) -> None:
        """Put in another, which holds no passkey; without answers its visitor is away."""
        if self.name:
            named = {"authenticatorId": self.name}
            self.session.send("WebAuthn.removeVirtualAuthenticator", named)
        options = {
            "protocol": "ctap2",
            "ctap2Version": "ctap2_1",
            "transport": "internal",
            "hasResidentKey": True,
            "hasUserVerification": True,
            "isUserVerified": True,
            "hasPrf": prf,
            "automaticPresenceSimulation": answers,
        }
        answer = self.session.send("WebAuthn.addVirtualAuthenticator", {"options": options})
        self.name = answer["authenticatorId"]

    def refuse(self) -> None:
        """Let the visitor fail the check of who they are, for good: it blocks after a few."""
        refused = {"authenticatorId": self.name, "isUserVerified": False}
        self.session.send("WebAuthn.setUserVerified", refused)

    def passkeys(self) -> int:
        """How many passkeys it holds."""
        held = self.session.send("WebAuthn.getCredentials", {"authenticatorId": self.name})
        return len(held["credentials"])

    def holder_key(self, subject: str) -> str:
        """The key that its passkey gives for a subject, computed without the page's modules."""
        label = (LABEL + subject).encode()
        secret = bytes(self.page.evaluate(EVALUATE, list(hashlib.sha256(label).digest())))
        key = HKDF(SHA256(), length=32, salt=None, info=label).derive(secret)
        return base64.urlsafe_b64encode(key).decode().rstrip("=")
