"""Typed configuration: the same frozen pydantic models are the YAML file, the flags and what a run saves."""

from __future__ import annotations

import difflib
import math
import operator
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    PlainSerializer,
    ValidationError,
    ValidationInfo,
    field_validator,
)

from outlap.errors import OutlapError, short_repr
from outlap.files import atomic_write

LONGEST_VALUE = 60  # characters of a wrong value that an error message repeats


class Config(BaseModel):
    """Base of every configuration: frozen, no unknown fields, no NaN or infinity, defaults validated too."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    @field_validator("*", mode="before")
    @classmethod
    def _refuse_bool_as_number(cls, value: Any, info: ValidationInfo) -> Any:
        # pydantic reads `seed: yes` as 1; in a configuration that is a mistake.
        numeric = cls.model_fields[info.field_name or ""].annotation in (int, float)
        if numeric and isinstance(value, bool):
            raise ValueError("must be a number")
        return value


ConfigT = TypeVar("ConfigT", bound=BaseModel)


def _finite(value: Any) -> float:
    try:
        # bool is an int in Python, but `mu: yes` in a file is a mistake and not a friction of 1.
        if isinstance(value, bool) or not isinstance(value, (int, float, str)):
            raise ValueError
        number = float(value)  # from text too: YAML 1.1 reads `1e-3` as a string
    except ValueError:
        raise ValueError("must be a number or a range {min: a, max: b}") from None
    if not math.isfinite(number):
        raise ValueError("must be finite")
    return number


def _number_or_range(value: Any) -> float | tuple[float, float]:
    if isinstance(value, Mapping):
        if set(value) != {"min", "max"}:
            raise ValueError("must have exactly the two keys min and max")
        value = (value["min"], value["max"])
    if not isinstance(value, (tuple, list)):
        return _finite(value)
    if len(value) != 2:
        raise ValueError("must be a number or a range {min: a, max: b}")
    low, high = _finite(value[0]), _finite(value[1])
    if low > high:
        raise ValueError("must have min <= max")
    return low, high


def _as_mapping(value: Any) -> Any:
    return {"min": value[0], "max": value[1]} if isinstance(value, tuple) else value


Number = Annotated[
    float | tuple[float, float], BeforeValidator(_number_or_range), PlainSerializer(_as_mapping, return_type=Any)
]
"""A value, or a range (min, max) from which one is drawn anew at each reset.

In a file `0.8` or `{min: 0.5, max: 1.1}`; as a flag `--vehicle.mu 0.8` or `--vehicle.mu 0.5 1.1`.
`Field(gt=0)` cannot compare a range: limit a Number with `bounded`.
"""


@dataclass(frozen=True)
class Interval:
    """Where both ends of a `Number` must lie; called with one, it lets it through or says why not."""

    above: float | None = None
    at_least: float | None = None
    below: float | None = None
    at_most: float | None = None

    def __call__(self, value: float | tuple[float, float]) -> float | tuple[float, float]:
        low, high = bounds(value)
        rules = [
            (operator.gt, low, ">", self.above),
            (operator.ge, low, ">=", self.at_least),
            (operator.lt, high, "<", self.below),
            (operator.le, high, "<=", self.at_most),
        ]
        if not all(limit is None or holds(end, limit) for holds, end, _, limit in rules):
            wanted = " and ".join(f"{sign} {limit}" for _, _, sign, limit in rules if limit is not None)
            raise ValueError(f"must be {wanted}")
        return value


def bounded(**limits: float) -> AfterValidator:
    """Limit a `Number`, at both ends if it is a range: `mu: Annotated[Number, bounded(above=0)]`; see `Interval`."""
    return AfterValidator(Interval(**limits))


def widest(cls: type[BaseModel], field: str) -> tuple[float, float]:
    """Return the limits of a field of type `Number`; infinite where it has none."""
    lows, highs = [-math.inf], [math.inf]
    for each in cls.model_fields[field].metadata:
        if isinstance(each, AfterValidator) and isinstance(each.func, Interval):
            lows += [limit for limit in (each.func.above, each.func.at_least) if limit is not None]
            highs += [limit for limit in (each.func.below, each.func.at_most) if limit is not None]
    return max(lows), min(highs)


def bounds(number: float | tuple[float, float]) -> tuple[float, float]:
    """Return the smallest and the largest value of a `Number`; a fixed value is both."""
    return number if isinstance(number, tuple) else (number, number)


def load_config(cls: type[ConfigT], path: str | os.PathLike[str]) -> ConfigT:
    """Read a YAML file into `cls`; an empty file gives the defaults.

    Raises:
        OutlapError: one line with the file, the dotted field, the value and what would be right.
    """
    return validate(cls, read_yaml(path), str(Path(path)))


def read_yaml(path: str | os.PathLike[str]) -> Any:
    """Load a YAML file safely; an empty file is an empty mapping.

    Raises:
        OutlapError: one line with the file and what is wrong with it.
    """
    path = Path(path)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise OutlapError(f"{path}: no such file") from None
    except OSError as error:
        raise OutlapError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise OutlapError(f"{path}: is not UTF-8 text") from None
    except RecursionError:
        raise OutlapError(f"{path}: is nested too deeply") from None
    except (yaml.YAMLError, ValueError) as error:  # ValueError: what a date such as 2026-99-99 raises
        raise OutlapError(f"{path}: is not valid YAML: {_yaml_problem(error)}") from None
    return {} if content is None else content


def save_config(config: BaseModel, path: str | os.PathLike[str]) -> Path:
    """Write `config` as YAML that `load_config` reads back to an equal object; a kill leaves the old file."""
    content = config.model_dump(mode="json")
    return atomic_write(path, yaml.safe_dump(content, sort_keys=False, allow_unicode=True))


def validate(cls: type[ConfigT], content: Any, source: str) -> ConfigT:
    """Build `cls` from a mapping that came from `source` (a file name, for the message).

    Raises:
        OutlapError: one line with the source, the dotted field, the value and what would be right.
    """
    if not isinstance(content, Mapping):
        raise OutlapError(f"{source}: is {_short(content)}; must be a mapping of fields to values")
    try:
        return cls.model_validate(content)
    except ValidationError as error:
        raise OutlapError(f"{source}: {explain(error, cls)}") from None


def explain(error: ValidationError, cls: type[BaseModel] | None = None, prefix: str = "") -> str:
    """Return the first problem of a pydantic error as one line: field, value and what would be right.

    Args:
        error: what pydantic raised.
        cls: the model that was validated; with it a misspelt field gets its closest match.
        prefix: put in front of the dotted field, such as `--env.`.
    """
    problems = error.errors(include_url=False)
    # A misspelt name explains the others (a field missing, a default that does not fit): say it first.
    problem = next((each for each in problems if each["type"] == "extra_forbidden"), problems[0])
    location = problem["loc"]
    field = (prefix + ".".join(str(part) for part in location)).rstrip(".") or "the configuration"
    context, given = problem.get("ctx", {}), f"{field} is {_short(problem['input'])}"
    match problem["type"]:
        case "extra_forbidden":
            line = f"{field} is not a known field{_hint(cls, location)}"
        case "missing":
            line = f"{field} is missing; it must be given"
        case "value_error" if isinstance(problem["input"], BaseModel):  # the error names the field that is wrong
            line = f"{field}: {context['error']}"
        case "value_error":
            line = f"{given}; {context['error']}"
        case "greater_than" | "greater_than_equal" | "less_than" | "less_than_equal" as kind:
            sign = (">" if kind.startswith("greater") else "<") + ("=" if kind.endswith("equal") else "")
            line = f"{given}; must be {sign} {next(iter(context.values()))}"
        case "model_type":
            line = f"{given}; must be a mapping of fields to values"
        case "literal_error" | "enum":
            close = difflib.get_close_matches(str(problem["input"]), context["expected"].split("'")[1::2], 1)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            line = f"{given}; must be {context['expected']}{hint}"
        case _:
            rule = problem["msg"].replace("Input should ", "must ", 1)
            line = f"{given}; {rule[0].lower()}{rule[1:]}"
    more = len(problems) - 1
    return " ".join(line.split()) + (f" (and {more} more)" if more else "")


def _hint(cls: type[BaseModel] | None, location: Sequence[int | str]) -> str:
    model = cls
    for part in location[:-1]:
        if model is not None and isinstance(part, str):
            known = model.model_fields.get(part)  # none where the part names a member of a union
            model = None if known is None else _model_in(known.annotation)
    if model is None:
        return ""
    names = list(model.model_fields)
    close = difflib.get_close_matches(str(location[-1]), names, 1)
    return f"; did you mean {close[0]}?" if close else f"; the fields are {', '.join(names)}"


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """The model inside `Model`, `Model | None` or `tuple[Model, ...]`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((model for each in get_args(annotation) if (model := _model_in(each))), None)


def _short(value: Any) -> str:
    return "empty" if value is None else short_repr(value, LONGEST_VALUE)


def _yaml_problem(error: Exception) -> str:
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        return f"{error.problem} (line {error.problem_mark.line + 1})"
    return " ".join(str(error).split())
