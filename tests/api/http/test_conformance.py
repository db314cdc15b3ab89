"""Schemathesis against the running service."""

from pathlib import Path

import pytest

from tests.api.conformance import run_all, service

pytestmark = pytest.mark.long


def test_the_service_answers_as_its_document_says(tmp_path: Path) -> None:
    with service(tmp_path) as (server, deployment):
        runs = run_all(server, deployment, tmp_path / "reports", examples=4, seed=20261122)
        for run in runs:
            assert run.status == 0, run.output
            assert run.cases >= 100, run.output
        assert '"internal_error"' not in server.log.read_text()
