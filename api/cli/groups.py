"""Groups of people in a calibration: where their labels come from, and how rates are shown."""

from pathlib import Path

from api.cli.results import Table
from api.cli.verdict import shown_rate
from attacks.operating_point import ADVISED_PHOTOS
from models.extraction import Extraction
from templates.contract.document import Contract, Level, Rate
from templates.contract.levels import photos_in_words
from verify.evaluation.labels_file import Labels
from verify.group_rates import PhotoLabels


def labels_of(photos: Extraction, labels: Labels, root: Path) -> PhotoLabels:
    """Look up the labels of photos by their paths below the folder of people."""
    names = [path.relative_to(root).as_posix() for path in photos.paths]
    return PhotoLabels(
        {attribute: labels.column(attribute, names) for attribute in labels.attributes},
        "a label file",
    )


def group_tables(contract: Contract) -> list[Table]:
    """Show the rates of every group at the default level, for one photo and for as many as advised.

    ``--json`` has those of all levels and numbers of photos.
    """
    tables = []
    for calibration in contract.calibrations:
        level = {one.name: one for one in calibration.levels}.get(contract.default_level)
        if level is None or calibration.probe_photos not in (1, ADVISED_PHOTOS):
            continue
        if level.groups:
            tables.append(_group_table(level, photos=calibration.probe_photos))
    return tables


def _group_table(level: Level, *, photos: int) -> Table:
    return Table(
        f"by group at {level.name}, probes of {photos_in_words(photos)}; "
        "* too few trials to be judged",
        ("attribute", "group", "FMR within (95 %)", "FRR (95 %)"),
        [
            (
                entry.attribute,
                entry.group,
                _marked(entry.fmr, judged=entry.fmr_judged),
                _marked(entry.frr, judged=entry.frr_judged),
            )
            for entry in level.groups
        ],
    )


def _marked(rate: Rate, *, judged: bool) -> str:
    return shown_rate(rate) + ("" if judged else " *")
