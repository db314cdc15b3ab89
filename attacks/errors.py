"""What an audit cannot do."""

from templates.errors import VeilfaceError


class AuditError(VeilfaceError):
    """An attack or an audit that cannot be made as it was ordered."""
