"""Parts as data: their options, their names in a config, and what is said of options that are not legal."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, cast

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from mape.errors import ConfigError
from mape.near import did_you_mean, nearest

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)  # whose home is pydantic's own affair


class _InSentences(ModelMetaclass):
    """Says what is wrong where a model is made by hand: pydantic's own words name no way out.

    Made of tables it is told by who reads them; pydantic does not come by here then.
    """

    def __call__(self, *args: Any, **fields: Any) -> Any:
        try:
            return super().__call__(*args, **fields)
        except ValidationError as error:
            tables = " Lists and tables as they stand in TOML are taken by mape.from_table({...})."
            made_of = tables if any(isinstance(value, (list, dict)) for value in fields.values()) else ""
            raise ConfigError(explain(error, f"{self.__name__}: ", cast(type[BaseModel], self)) + made_of) from None


class PartConfig(BaseModel, metaclass=_InSentences):
    """Base of all options: frozen, strict, no unknown field, no NaN or infinity.

    Raises
    ------
    ConfigError
        Names each field that is wrong, its value, and what is legal.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class PartSpec(BaseModel, metaclass=_InSentences):
    """A part by short name or ``"module:Class"``, and its options; a string alone means no options."""

    model_config = ConfigDict(frozen=True, extra="allow", strict=True, allow_inf_nan=False)

    name: str = Field(min_length=1)

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value

    @property
    def options(self) -> dict[str, Any]:
        """Everything but the name."""
        return dict(self.model_extra or {})


def explain(error: ValidationError, prefix: str, model: type[BaseModel]) -> str:
    """Turn what pydantic found into one sentence per field, each after `prefix` and the field's dotted name."""
    lines = []
    for problem in error.errors():
        loc = ".".join(str(part) for part in problem["loc"])
        message = problem["msg"].removeprefix("Value error, ")
        if problem["type"] == "extra_forbidden":
            legal = _fields_at(model, problem["loc"][:-1])
            hint = did_you_mean(nearest(str(problem["loc"][-1]), legal))
            message = f"no such option{hint} Legal: {', '.join(legal) or 'none'}"
        elif problem["type"] == "missing":
            message = "is needed and missing"
        elif problem["type"] == "literal_error":
            legal = re.findall("'([^']*)'", message)
            message = f"{problem['input']!r} is not legal{did_you_mean(nearest(str(problem['input']), legal))} "
            message += f"Legal: {', '.join(legal)}"
        elif problem["type"] != "value_error":
            given = problem.get("input")
            message = f"{message[:1].lower()}{message[1:]}, got {'a table' if isinstance(given, dict) else repr(given)}"
        lines.append(f"{prefix}{loc}: {message}" if loc else f"{prefix.rstrip(': .')}: {message}")
    return "\n".join(lines)


def _fields_at(model: Any, loc: tuple[Any, ...]) -> list[str]:
    for part in loc:
        if isinstance(part, int):
            continue  # of a list of models the model stays
        fields = getattr(model, "model_fields", {})
        if part not in fields:
            return []
        annotation = fields[part].annotation
        kinds = [annotation, *getattr(annotation, "__args__", ())]
        model = next((kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel)), None)
    return [field.alias or name for name, field in getattr(model, "model_fields", {}).items()]
