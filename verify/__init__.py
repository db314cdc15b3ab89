"""Verification: a probe against a subject becomes a decision; metrics and calibration.

Imports the layer below only: ``templates`` and ``models``.
"""

from verify.calibration import Calibrated, CalibrationReport, calibrate
from verify.calibration_mode import CalibrationOptions
from verify.datasets import DatasetError, LabelledFolder, labelled_folder, read_lfw_pairs
from verify.decision import Decision
from verify.stand_ins import StandIn, lift_stand_in
from verify.verifier import Verifier

__all__ = [
    "Calibrated",
    "CalibrationOptions",
    "CalibrationReport",
    "DatasetError",
    "Decision",
    "LabelledFolder",
    "StandIn",
    "Verifier",
    "calibrate",
    "labelled_folder",
    "lift_stand_in",
    "read_lfw_pairs",
]
