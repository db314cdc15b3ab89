"""Values of a contract as JSON, and read from JSON.

pydantic checks every type and range, strictly: ``"1"`` and ``true`` are no integers, and nothing is
NaN. Then the value that was read is written again, and has to be what was given. So a key that
nobody knows, one that is missing, and one that contradicts the others are all refused, by one rule.

The checks are made where a value is read, and before a contract is written. A value that our own
code makes is not checked again.
"""

from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, ClassVar, Self

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from templates.contract.canonical import Json, canonical_json
from templates.errors import ContractError

Share = Annotated[float, Field(ge=0, le=1)]
Cosine = Annotated[float, Field(ge=-1, le=1)]
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


def refused(what: str, error: ValidationError) -> ContractError:
    """Say what is wrong first, and where; pydantic's own text quotes the input."""
    first = error.errors(include_input=False, include_url=False, include_context=False)[0]
    place, said = ".".join(map(str, first["loc"]))[:100], first["msg"]
    return ContractError(f"{what}{place and f', {place}'}: {said[:1].lower()}{said[1:]}")


class JsonValue:
    """Base of dataclasses that have a JSON form.

    ``what`` is what an error calls such a value.
    """

    what: ClassVar[str]
    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(
        strict=True, allow_inf_nan=False, val_json_bytes="hex"
    )

    @classmethod
    @cache
    def _adapter(cls) -> TypeAdapter[Any]:
        return TypeAdapter(cls)

    def to_json(self) -> dict[str, Json]:
        """JSON form: the fields by their names, and what is computed from them."""
        written: dict[str, Json] = self._adapter().dump_python(
            self, mode="json", by_alias=True, warnings=False
        )
        return written

    @classmethod
    def from_json(cls, value: object, **unwritten: str) -> Self:
        """Read JSON, and fields that the JSON form leaves out: bytes, in hexadecimal.

        Raises
        ------
        ContractError
            Where a type or a value is wrong, or the value is not what :meth:`to_json` gives.
        """
        if not isinstance(value, Mapping):
            raise ContractError(f"{cls.what} is not a JSON object")
        try:
            made: Self = cls._adapter().validate_json(canonical_json({**value, **unwritten}))
        except ValidationError as error:
            raise refused(cls.what, error) from None
        if canonical_json(made.to_json()) != canonical_json(value):
            raise ContractError(
                f"{cls.what} has an entry too many or too few, or one that contradicts the others"
            )
        return made
