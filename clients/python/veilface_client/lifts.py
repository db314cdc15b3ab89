"""What a client has lifted: templates that enroll, and probes; no photo, and no embedding."""

from typing import Self

from pydantic import BaseModel, ConfigDict, Field


class Value(BaseModel):
    """A frozen value; fields that this version does not know are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class _Lift(Value):
    template: bytes = Field(repr=False)
    contract_id: str

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {len(self.template)} bytes>"

    @classmethod
    def of(cls, template: bytes, contract_id: str) -> Self:
        """Make a lift."""
        return cls(template=template, contract_id=contract_id)


class Probe(_Lift):
    """A lifted probe: no photo, and no embedding. Use it once for each attempt it is meant for."""


class Enrollable(_Lift):
    """A template that enrolls, lifted and not yet (or perhaps) sent: no photo, no embedding."""
