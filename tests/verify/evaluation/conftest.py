import pytest

from verify.evaluation import embeddings_file
from verify.evaluation.readers import agedb, insightface_bin


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read without a process for each file, which takes a second; `test_isolated.py` has it."""
    for reader in (agedb, embeddings_file, insightface_bin):
        monkeypatch.setattr(reader, "isolated", lambda read, file: read(file))
