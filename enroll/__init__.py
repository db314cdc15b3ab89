"""Enrollment: photos or a client's template become one private template of a subject."""
