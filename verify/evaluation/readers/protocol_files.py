"""The small text files that define a benchmark, read whole and fingerprinted."""

from dataclasses import dataclass
from pathlib import Path

from verify.datasets import MAX_PAIRS_BYTES, DatasetError
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


def read_whole(file: Path, *, most: int) -> bytes:
    """Read a file of at most ``most`` bytes.

    Raises
    ------
    DatasetError
        The file is larger, or cannot be read.
    """
    try:
        if not file.is_file():
            raise DatasetError(f"{file} is not there")
        with file.open("rb") as stream:
            data = stream.read(most + 1)
    except OSError as error:
        raise DatasetError(f"{file} cannot be read: {error.strerror}") from None
    except MemoryError:
        raise DatasetError(f"{file} is larger than the memory of this machine") from None
    if len(data) > most:
        raise DatasetError(f"{file} is larger than {most} bytes")
    return data


def read_text(file: Path, *, root: Path) -> ProtocolText:
    """Read UTF-8 text, with or without a byte-order mark.

    Raises
    ------
    DatasetError
        The file is absent, too large or not UTF-8.
    """
    data = read_whole(file, most=MAX_PAIRS_BYTES)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise DatasetError(f"{file} is not UTF-8 text; save it as UTF-8") from None
    return ProtocolText(file.relative_to(root).as_posix(), digest_of(data), text)
