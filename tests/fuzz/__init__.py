"""Fuzzing of the readers of hostile bytes; ``python -m tests.fuzz --help``.

``targets`` names the readers and what each may do with its input, ``corpus`` makes the inputs of
each, ``child`` reads them under limits, ``runner`` watches it, ``report`` counts.
"""
