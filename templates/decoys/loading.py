"""Opening a decoy file without being told what it holds."""

from pathlib import Path

from templates.decoys.generator import DecoyGenerator
from templates.decoys.pool import POOL_MAGIC, DecoyPool
from templates.decoys.source import DecoySource
from templates.errors import DecoyError
from templates.keys.sealing import Sealer


def load_source(path: Path, sealer: Sealer) -> DecoyPool | DecoyGenerator:
    """Load a sealed pool or a plain generator, told apart by the first bytes of the file.

    Raises
    ------
    DecoyError
        The file cannot be read, or is neither.
    SealError
        It is a pool that the sealer's key does not open.
    """
    try:
        with path.open("rb") as file:
            start = file.read(len(POOL_MAGIC))
    except OSError as error:
        raise DecoyError(f"cannot read {path.name}: {error.strerror}") from error
    return DecoyPool.load(path, sealer) if start == POOL_MAGIC else DecoyGenerator.load(path)


def client_source(source: DecoySource) -> DecoyGenerator:
    """Return the generator that lifting clients receive, never a pool.

    A generator is returned as it is; to a pool one is fitted, always the same for the same pool.

    Raises
    ------
    DecoyError
        It is neither.
    """
    if isinstance(source, DecoyPool):
        return source.fitted
    if not isinstance(source, DecoyGenerator):
        raise DecoyError("clients lift with a decoy generator, and this source is another kind")
    return source
