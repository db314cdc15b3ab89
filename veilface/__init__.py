"""The one package that Veilface takes in an environment.

In a wheel the packages of the repository (``api``, ``models``, ``templates`` and so on) lie inside
this one; in a checkout they lie beside it. Importing it puts their folder first on ``sys.path``.
So a folder ``api`` in ``PYTHONPATH``, or of another distribution, is never taken for ours.
"""

import sys
from pathlib import Path

_here = Path(__file__).resolve().parent
sys.path.insert(0, str(_here if (_here / "api").is_dir() else _here.parent))
