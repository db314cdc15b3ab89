"""Recognise a benchmark by what lies at its path."""

import csv
from pathlib import Path

from verify.datasets import DatasetError
from verify.evaluation.readers.agedb import PROTOCOL, read_agedb
from verify.evaluation.readers.cfp import LIST, read_cfp
from verify.evaluation.readers.insightface_bin import read_bin
from verify.evaluation.readers.lfw import PAIRS, read_lfw
from verify.evaluation.readers.pair_csv import REQUIRED, read_pair_csv
from verify.evaluation.verification_set import VerificationSet

LAYOUTS = (
    "an InsightFace .bin file; a pair CSV (path_a,path_b,same[,fold]); an LFW folder (pairs.txt "
    "and Name/Name_0001.jpg); a CFP folder (Protocol/ and Data/); an AgeDB-30 folder "
    f"({PROTOCOL} and 03_Protocol_Images/)"
)


def open_sets(path: Path, *, pictures: bool = True) -> list[VerificationSet]:
    """Read the verification sets at ``path``; a CFP folder holds two.

    Parameters
    ----------
    pictures
        Whether the photos themselves must be there. They need not be where descriptors were
        computed elsewhere; their names are then those of the protocol.

    Raises
    ------
    DatasetError
        Saying what was seen and what is understood, or what is wrong with the set.
    """
    try:
        if path.is_dir():
            return _folder(path, pictures=pictures)
        if path.is_file():
            return [_file(path, pictures=pictures)]
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}") from None
    raise DatasetError(f"{path} is not there. Understood are: {LAYOUTS}")


def _file(path: Path, *, pictures: bool) -> VerificationSet:
    with path.open("rb") as stream:
        head = stream.read(1024)
    # Protocols 2 to 5 begin with their number; 0 and 1 are known by the suffix only.
    if path.suffix.lower() == ".bin" or (head[:1] == b"\x80" and head[1:2] in b"\2\3\4\5"):
        return read_bin(path)
    first = head.decode("utf-8-sig", "replace").splitlines()[:1]
    columns = next(csv.reader(first), []) if first else []
    if path.suffix.lower() == ".csv" or columns[:1] == [REQUIRED[0]]:
        return read_pair_csv(path, pictures=pictures)
    remedy = "; give its folder" if path.name in (PAIRS, PROTOCOL) else ""
    raise DatasetError(f"{path} is a file of another kind{remedy}. Understood are: {LAYOUTS}")


def _folder(path: Path, *, pictures: bool) -> list[VerificationSet]:
    marks = {"LFW": PAIRS, "CFP": LIST.format("F"), "AgeDB-30": PROTOCOL}
    kinds = _marks(path, marks)
    if not kinds:
        # An archive that was unpacked into a folder of its own.
        inside = sorted(one for one in path.iterdir() if one.is_dir() and one.name[0] != ".")
        if len(inside) == 1:
            path, kinds = inside[0], _marks(inside[0], marks)
    match kinds:
        case ["LFW"]:
            return [read_lfw(path, pictures=pictures)]
        case ["CFP"]:
            return read_cfp(path, pictures=pictures)
        case ["AgeDB-30"]:
            return [read_agedb(path, pictures=pictures)]
        case []:
            entries = sorted(one.name for one in path.iterdir() if one.name[0] != ".")
            seen = ", ".join(entries[:5]) + (" …" if len(entries) > 5 else "")
            raise DatasetError(
                f"{path} is a folder with {seen or 'nothing'} in it and no protocol. "
                f"Understood are: {LAYOUTS}"
            )
    seen = " and ".join(marks[kind] for kind in kinds)
    raise DatasetError(f"{path} holds {seen}: which of {' and '.join(kinds)} is it? Separate them")


def _marks(path: Path, marks: dict[str, str]) -> list[str]:
    return [kind for kind, mark in marks.items() if (path / mark).is_file()]
