"""The small text files that define a benchmark, read whole and fingerprinted."""

from dataclasses import dataclass
from pathlib import Path

from verify.datasets import MAX_PAIRS_BYTES, decoded, read_whole
from verify.evaluation.verification_set import digest_of


@dataclass(frozen=True)
class ProtocolText:
    """Text of a file with its name relative to the set, and the SHA-256 of its bytes."""

    name: str
    sha256: str
    text: str

    @property
    def fingerprint(self) -> tuple[str, str]:
        """Name and SHA-256, as ``VerificationSet.protocol_files`` lists them."""
        return self.name, self.sha256


def read_text(file: Path, *, root: Path) -> ProtocolText:
    """Read UTF-8 text, with or without a byte-order mark.

    Raises
    ------
    DatasetError
        The file is absent, too large or not UTF-8.
    """
    data = read_whole(file, most=MAX_PAIRS_BYTES)
    return ProtocolText(
        file.relative_to(root).as_posix(), digest_of(data), decoded(data, file=file)
    )
