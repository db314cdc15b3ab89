"""Readers of benchmark sets, one a module; a new one is found by lying in this folder."""

import pkgutil
from importlib import import_module
from pathlib import Path

from verify.datasets import DatasetError
from verify.evaluation.readers.reader import Reader
from verify.evaluation.verification_set import VerificationSet


def _readers() -> list[Reader]:
    modules = (
        import_module(f"{__name__}.{entry.name}") for entry in pkgutil.iter_modules(__path__)
    )
    return [module.READER for module in modules if hasattr(module, "READER")]


def open_sets(path: Path, *, pictures: bool = True) -> list[VerificationSet]:
    """Read the verification sets at ``path``; a CFP folder holds two."""
    readers = _readers()
    understood = f"Understood are: {'; '.join(reader.layout for reader in readers)}"
    try:
        if not path.exists():
            raise DatasetError(f"{path} is not there. {understood}")
        able = [reader for reader in readers if reader.recognises(path)]
        if len(able) == 1:
            return able[0].read(path, pictures)
        if able:
            kinds = " and ".join(reader.layout for reader in able)
            raise DatasetError(f"{path} holds {kinds}: which one is it? Separate them")
        seen = "a file of another kind; of a set in a folder, give the folder"
        if path.is_dir():
            entries = sorted(one.name for one in path.iterdir() if one.name[0] != ".")
            shown = ", ".join(entries[:5]) + (" …" if len(entries) > 5 else "")
            seen = f"a folder with {shown or 'nothing'} in it and no protocol"
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}") from None
    raise DatasetError(f"{path} is {seen}. {understood}")
