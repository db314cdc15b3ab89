"""A short run of what ``python -m tests.api.conformance`` does at length."""

import json
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import httpx
import pytest

from tests.api.conformance import run_all, schemathesis, service
from tests.api.deployment import bearer
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.long


def test_the_service_answers_as_its_document_says(tmp_path: Path) -> None:
    with service(tmp_path) as (server, deployment):
        runs = run_all(server, deployment, tmp_path / "reports", examples=4, seed=20261122)
        for run in runs:
            assert run.status == 0, run.output
            assert run.cases >= 100, run.output
        assert '"internal_error"' not in server.log.read_text()


def test_a_service_that_lies_is_found(tmp_path: Path) -> None:
    """The control: an answer that breaks its schema fails the run."""
    # The server is another process, so its document is changed: it promises that the list of
    # subjects has a field that no answer has.
    with service(tmp_path) as (server, deployment):
        document = httpx.get(f"{server.url}/v1/openapi.json", timeout=PATIENCE_S).json()
        document["paths"] = {"/v1/subjects": document["paths"]["/v1/subjects"]}
        answer = document["components"]["schemas"]["SubjectsAnswer"]
        answer["required"] = [*answer["required"], "total"]
        answer["properties"]["total"] = {"type": "integer"}
        document["servers"] = [{"url": server.url}]

        class Document(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                body = json.dumps(document).encode()
                self.send_response(200)
                self.send_header("Content-Type", "application/json")
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *arguments: object) -> None:
                pass

        with HTTPServer(("127.0.0.1", 0), Document) as beside:
            thread = threading.Thread(target=beside.serve_forever)
            thread.start()
            try:
                run = schemathesis(
                    "liar",
                    f"http://127.0.0.1:{beside.server_port}",
                    tmp_path / "reports",
                    headers=bearer(deployment.token),
                    examples=2,
                    seed=1,
                )
            finally:
                beside.shutdown()
                thread.join()
    assert run.status != 0
    assert "total" in run.output
