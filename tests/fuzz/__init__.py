"""Fuzzing of the readers of hostile bytes; ``python -m tests.fuzz --help``.

``targets`` names the readers and what each may do with its input, ``pictures``, ``tensors``,
``documents``, ``bodies`` and ``pickles`` make the inputs, ``reading`` reads them under limits in a
process of its own.
"""
