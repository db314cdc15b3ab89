"""Verification: a probe against a subject becomes a decision; metrics and calibration."""
