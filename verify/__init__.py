"""Verification: a probe against a subject becomes a decision; metrics and calibration.

Imports the layer below only: ``templates`` and ``models``.
"""

from verify.calibration import Calibrated, calibrate
from verify.calibration_mode import CalibrationOptions, CalibrationReport
from verify.challenge import MAX_FRAMES, MIN_FRAMES, Movement, draw_movements
from verify.datasets import DatasetError, LabelledFolder, labelled_folder
from verify.decision import Decision, StandIn
from verify.photo_probe import (
    MAX_PROBE_PHOTOS,
    PhotoProbe,
    probe_of_embeddings,
    probe_of_frames,
    probe_of_photos,
)
from verify.verifier import OpenedTemplate, Verifier

__all__ = [
    "MAX_FRAMES",
    "MAX_PROBE_PHOTOS",
    "MIN_FRAMES",
    "Calibrated",
    "CalibrationOptions",
    "CalibrationReport",
    "DatasetError",
    "Decision",
    "LabelledFolder",
    "Movement",
    "OpenedTemplate",
    "PhotoProbe",
    "StandIn",
    "Verifier",
    "calibrate",
    "draw_movements",
    "labelled_folder",
    "probe_of_embeddings",
    "probe_of_frames",
    "probe_of_photos",
]
