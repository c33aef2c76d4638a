"""Words for the shapes of JSON documents, written as JSON Schema (draft 2020-12).

Objects are closed: a key that is not listed is an error. NUMBER includes null, as documents write what is not a number.
"""

from __future__ import annotations

import types
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

Shape = dict[str, Any]

TEXT: Shape = {"type": "string"}
FLAG: Shape = {"type": "boolean"}
COUNT: Shape = {"type": "integer"}
NUMBER: Shape = {"type": ["number", "null"]}
ANYTHING: Shape = {}
_MAYBE = "x-may-be-absent"


def record(shapes: dict[str, Shape] | None = None, /, **more: Shape) -> Shape:
    """An object of these keys, all required but those that are `maybe`, and no others."""
    found = dict(shapes or {}) | more
    required = [key for key, shape in found.items() if _MAYBE not in shape]
    properties = {key: {k: v for k, v in shape.items() if k != _MAYBE} for key, shape in found.items()}
    return {"type": "object", "properties": properties, "required": required, "additionalProperties": False}


def with_others(shape: Shape) -> Shape:
    """The same object, to which further keys may be added."""
    return {key: value for key, value in shape.items() if key != "additionalProperties"}


def maybe(shape: Shape) -> Shape:
    """The shape of a key that may be absent."""
    return shape | {_MAYBE: True}


def or_null(shape: Shape) -> Shape:
    """The shape, or null."""
    return {"anyOf": [shape, {"type": "null"}]}


def one_of(*values: str) -> Shape:
    """One of these words."""
    return {"enum": list(values)}


def many(shape: Shape, least: int | None = None, most: int | None = None) -> Shape:
    """A list of such."""
    limits = {"minItems": least, "maxItems": least if most is None else most}
    return {"type": "array", "items": shape} | {key: value for key, value in limits.items() if value is not None}


def by_name(shape: Shape) -> Shape:
    """An object whose keys are names of things, each with such a value."""
    return {"type": "object", "additionalProperties": shape}


def ref(name: str) -> Shape:
    """A shape that has a name of its own in `$defs`."""
    return {"$ref": f"#/$defs/{name}"}


def fields_of(made: type, **changed: Shape) -> Shape:
    """The object that a dataclass becomes: its fields by their types."""
    hints = get_type_hints(made)
    return record({item.name: changed.get(item.name, _of(hints[item.name])) for item in fields(made)})


def _of(hint: Any) -> Shape:
    origin, inner = get_origin(hint), get_args(hint)
    plain: dict[Any, Shape] = {bool: FLAG, int: COUNT, float: NUMBER, str: TEXT, Path: TEXT, Any: ANYTHING}
    if hint in plain:
        return plain[hint]
    if origin in (Union, types.UnionType):
        shapes = [_of(part) for part in inner if part is not type(None)]
        whole = shapes[0] if len(shapes) == 1 else {"anyOf": shapes}
        return or_null(whole) if type(None) in inner else whole
    if origin is Literal:
        return one_of(*inner)
    if origin is np.ndarray or hint is np.ndarray:
        return {"type": "array"}
    if origin in (tuple, list) or getattr(origin, "__name__", "") == "Sequence":
        if origin is tuple and inner[-1] is not Ellipsis:
            return {"type": "array", "prefixItems": [_of(part) for part in inner], "minItems": len(inner), "maxItems": len(inner)}
        return many(_of(inner[0]))
    if origin is dict or getattr(origin, "__name__", "") == "Mapping":
        return by_name(_of(inner[1]))
    if hasattr(hint, "__dataclass_fields__"):
        return fields_of(hint)
    raise TypeError(f"{hint} has no shape in JSON; name it in fields_of")
