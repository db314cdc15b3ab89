"""From photos, or a client's template, to the one private template of a subject."""

from enroll.enroller import Enroller, Enrollment, Holder

__all__ = ["Enroller", "Enrollment", "Holder"]
