"""Results by group for every row of an evaluated set."""

from verify.evaluation.evaluation import Evaluated
from verify.evaluation.groups import by_group
from verify.evaluation.labels_file import Labels
from verify.evaluation.rows import Json, cell_json, grouped
from verify.evaluation.verification_set import VerificationSet


def group_rows(
    pairs: VerificationSet, evaluated: Evaluated, labels: Labels, *, seed: int
) -> tuple[list[Json], list[Json]]:
    """Count errors by group at the threshold that holds for all, in every row and target.

    Returns
    -------
    groups, summaries
        Entries for each group, and one for all groups of an attribute together.
    """
    names = [picture.name for picture in pairs.pictures]
    groups: list[Json] = []
    summaries: list[Json] = []
    for attribute in labels.attributes:
        column = labels.column(attribute, names)
        first = [column[place] for place in pairs.first[evaluated.kept].tolist()]
        second = [column[place] for place in pairs.second[evaluated.kept].tolist()]
        for (cell, search), runs in grouped(evaluated.runs).items():
            if search != "exact":
                continue
            head = {"dataset": pairs.name, **cell_json(cell), "seed": seed}
            for place, errors in enumerate(runs[0].measures.at):
                report = by_group(
                    [run.similarities for run in runs],
                    evaluated.material.same,
                    first,
                    second,
                    attribute=attribute,
                    thresholds=[run.measures.at[place].threshold for run in runs],
                    target_fmr=errors.target,
                )
                groups += [{**head, **entry} for entry in report.json()]
                summaries.append({**head, **report.summary()})
    return groups, summaries
