"""What a command hands back: a document for programs, lines for people, and whether what was inspected is fit."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Outcome:
    """Result of a command. `document` carries its schema; `fit` False becomes exit status 1."""

    document: dict[str, Any]
    lines: list[str] = field(default_factory=list)
    fit: bool = True


def document(name: str, **content: Any) -> dict[str, Any]:
    """A JSON-ready document of schema rangecheck/NAME/1; NaN and infinity become null, paths and arrays plain values."""
    return {"schema": f"rangecheck/{name}/1"} | {key: _plain(value) for key, value in content.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, set)):
        return [_plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    return str(value)
