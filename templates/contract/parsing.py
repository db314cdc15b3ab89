"""Values of a contract as JSON, and read from JSON.

pydantic checks every type and range, strictly: ``"1"`` and ``true`` are no integers, and nothing is
NaN. Then the value that was read is written again, and has to be what was given. So a key that
nobody knows, one that is missing, and one that contradicts the others are all refused, by one rule.

The checks are made where a value is read, and before a contract is written. A value that our own
code makes is not checked again.
"""

import dataclasses
from collections.abc import Mapping
from enum import Enum
from functools import cache
from typing import Annotated, Any, ClassVar, Self

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from templates.contract.canonical import Json, canonical_json, plain_json
from templates.errors import ContractError

Share = Annotated[float, Field(ge=0, le=1)]
Cosine = Annotated[float, Field(ge=-1, le=1)]
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class JsonValue:
    """Base of dataclasses that have a JSON form.

    ``what`` is what an error calls such a value.
    """

    what: ClassVar[str]
    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(
        strict=True, allow_inf_nan=False, val_json_bytes="hex"
    )

    def to_json(self) -> dict[str, Json]:
        """JSON form: the fields by their names."""
        fields = dataclasses.fields(self)  # type: ignore[arg-type]
        return {entry.name: _plain(getattr(self, entry.name)) for entry in fields}

    @classmethod
    def from_json(cls, value: object, **unwritten: str) -> Self:
        """Read JSON, and fields that the JSON form leaves out: bytes, in hexadecimal.

        Raises
        ------
        ContractError
            Where a type or a value is wrong, or the value is not what :meth:`to_json` gives.
        """
        given = plain_json(value)
        if not isinstance(given, dict):
            raise ContractError(f"{cls.what} is not a JSON object")
        try:
            text = canonical_json({**given, **unwritten})
            made: Self = _adapter(cls).validate_json(text)  # type: ignore[arg-type]
        except ValidationError as error:
            # Its own text quotes the input.
            first = error.errors(include_input=False, include_url=False, include_context=False)[0]
            known = {entry.name for entry in dataclasses.fields(cls)}  # type: ignore[arg-type]
            place = ": ".join(str(part) for part in first["loc"][:1] if part in known)
            raise ContractError(
                f"{cls.what}{f', {place}' if place else ''}: {first['msg'].lower()}"
            ) from None
        written = plain_json(made.to_json())
        if given != written:
            raise ContractError(
                f"{cls.what} has an entry too many or too few, or one that contradicts the others"
            )
        return made


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def _plain(value: Any) -> Any:
    if isinstance(value, JsonValue):
        return value.to_json()
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return str(value) if isinstance(value, Enum) else value
