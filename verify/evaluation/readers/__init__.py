"""Readers of benchmark sets: InsightFace ``.bin``, LFW, CFP and AgeDB-30 folders, pair CSV."""

from verify.evaluation.readers.agedb import read_pts
from verify.evaluation.readers.notes import notes
from verify.evaluation.readers.opening import open_sets

__all__ = ["notes", "open_sets", "read_pts"]
