"""From photos, or a client's template, to the one private template of a subject.

Imports the layer below only: ``templates`` and ``models``.
"""

from enroll.enroller import Enroller, Enrollment, Holder
from enroll.public_contract import PublicContract

__all__ = [
    "Enroller",
    "Enrollment",
    "Holder",
    "PublicContract",
]
