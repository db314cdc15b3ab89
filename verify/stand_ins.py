"""What a subject that does not exist is decided against, so that its answer costs as any other."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class StandIn:
    """A template of nobody, which no probe is accepted for.

    Attributes
    ----------
    wire
        Its wire bytes.
    template_id
        Any, as long as a real one: a rotation is derived from it, as from a real one.
    holder_salt
        None: no key would be the holder's.
    """

    wire: bytes = field(repr=False)
    template_id: str = "0" * 32
    holder_salt: str | None = None
