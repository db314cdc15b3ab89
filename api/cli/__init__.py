"""The ``veilface`` command line. Each command is a thin caller of the packages below.

stdout carries results, and with ``--json`` nothing but JSON; messages and progress go to stderr.
Exit status: 0 done or accepted, 1 rejected or failed, 2 wrong usage. Where `verify` fails it makes
no decision, and ends with 3.
"""

from api.cli.app import app, main

__all__ = ["app", "main"]
