"""JSON that is read back, held to its schema before anything is made of it."""

from __future__ import annotations

import functools
import json
import math
from pathlib import Path
from typing import Any

from meshreg.errors import InputError
from meshreg.settings.checked import shown

LARGEST = 1e15  # of any number; squares and products of such are still finite


def parse_json(text: bytes, file: Path) -> Any:
    """Return a JSON text as plain values.

    Raises
    ------
    InputError
        It is no JSON; NaN, infinity and numbers over 1e15 are none here.
    """

    def refuse(constant: str) -> None:
        raise InputError(f"holds {constant}, which is not JSON.", file=file)

    def whole(digits: str) -> int | float:
        return int(digits) if len(digits) < 19 else math.inf  # refused below, with its place

    try:
        document = json.loads(text.decode("utf-8"), parse_constant=refuse, parse_int=whole)
        place = _too_large(document, "")
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise InputError(f"is not JSON: {error.msg}.", file=file, place=where) from error
    except (UnicodeDecodeError, RecursionError, ValueError) as error:
        raise InputError(f"is not JSON text: {error}.", file=file) from error
    if place:
        raise InputError(f"has a number over {LARGEST:g}.", file=file, place=place)
    return document


def _too_large(value: Any, place: str) -> str:
    """Return the place of the first number that is over `LARGEST`, "" where there is none."""
    if isinstance(value, int | float):
        return "" if abs(value) <= LARGEST else place
    items: Any = ()
    if isinstance(value, dict):
        items = ((item, f"{place}.{key[:100]}" if place else key) for key, item in value.items())
    elif isinstance(value, list):
        items = ((item, f"{place}[{index}]") for index, item in enumerate(value))
    return next((found for item, here in items if (found := _too_large(item, here))), "")


def require_schema(document: Any, schema: str, file: Path, remedy: str) -> None:
    """Hold a document to a schema in `result/`.

    Parameters
    ----------
    document : object
    schema : str
        Its file: "registration.schema.json".
    file : Path
        For the message.
    remedy : str

    Raises
    ------
    InputError
        Naming the first place that does not fit, its value, and what is wanted there.
    """
    from fastjsonschema import JsonSchemaValueException

    try:
        _validator(schema)(document)
    except JsonSchemaValueException as error:
        place = str(error.name).removeprefix("data").removeprefix(".")
        wanted = str(error.message).removeprefix(str(error.name)).strip()
        if "exactly by one definition" in wanted:
            wanted = f"must fit one of its definitions in {schema}"
        raise InputError(
            f"is {shown(error.value)}; it {wanted}.", file=file, place=place or None, remedy=remedy
        ) from error


@functools.cache
def _validator(schema: str) -> Any:
    import fastjsonschema

    rules = json.loads(
        (Path(__file__).parent.parent / "result" / schema).read_text(encoding="utf-8")
    )
    del rules["$id"]  # it would be looked up as an address; every reference is within the file
    return fastjsonschema.compile(rules, use_default=False)
