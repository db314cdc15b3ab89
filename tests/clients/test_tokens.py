"""A server asks for tokens with its key, and whoever holds one is let in once."""

import pytest

from tests.api.deployment import photo
from tests.clients.conftest import Running, service
from veilface_client import Client, EnrollmentConflict, Forbidden, Unauthorized

__all__ = ["service"]


def test_a_token_is_used_once_and_its_outcome_is_told(service: Running) -> None:
    with Client(service.url, service.deployment.token) as server:
        writing = server.create_token("tina", "enroll")
        with Client(service.url, writing.token) as page:
            assert not page.enroll("tina", photo(1)).replaced
            with pytest.raises(Unauthorized, match="used before"):
                page.enroll("tina", photo(2))
        assert server.token_outcome("tina", writing.token_id).outcome == "created"
        late = server.create_token("tina", "enroll", replace=False)
        with Client(service.url, late.token) as page, pytest.raises(EnrollmentConflict):
            page.enroll("tina", photo(2))
        for person in (1, 2):
            issued = server.create_token("tina", "verify", level="fmr-1e-3", lifetime_s=60)
            assert issued.token not in repr(issued)
            assert not server.token_outcome("tina", issued.token_id).used
            with Client(service.url, issued.token) as page:
                with pytest.raises(Forbidden):
                    page.verify("tom", photo(person, 3))
                decision = page.verify("tina", photo(person, 3))
                assert bool(decision) is (person == 1)
                with pytest.raises(Unauthorized, match="used before"):
                    page.verify("tina", photo(person, 3))
            outcome = server.token_outcome("tina", issued.token_id)
            assert (bool(outcome), outcome.level) == (person == 1, "fmr-1e-3")


def test_what_cannot_be_a_token_is_refused_here(service: Running) -> None:
    with Client(service.url, service.deployment.token) as server:
        with pytest.raises(ValueError, match="subject id"):
            server.create_token("a/b", "verify")
        with pytest.raises(ValueError, match="token_id"):
            server.token_outcome("tina", "../tina")
