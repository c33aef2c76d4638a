"""The story: the only room that knows every stage and the configuration; each command is one function here.

The functions are found in their own files and loaded when first asked for, so that a command loads no other command's rooms.
"""

from __future__ import annotations

import importlib
from typing import Any

from rangecheck.pipeline.outcome import Outcome

_WHERE = {
    "check": "inspect",
    "dataset": "vision",
    "decode": "captures",
    "doctor": "health",
    "draw": "views",
    "explain": "inspect",
    "init": "beginning",
    "fit": "fitting",
    "maps": "views",
    "materials": "inspect",
    "mesh": "scanning",
    "rehearse": "rehearsing",
    "rehearse_dataset": "rehearsing",
    "rehearse_turntable": "rehearsing",
    "render": "pictures",
    "report": "page",
    "run": "job",
    "run_each": "many",
    "sample": "scanning",
    "schema": "beginning",
    "simulate": "simulating",
    "solid": "shape",
    "study": "inspect",
    "turntable": "turning",
}

__all__ = ["Outcome", *_WHERE]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"rangecheck.pipeline has no command {name!r}")
    module = importlib.import_module(f"rangecheck.pipeline.{_WHERE[name]}")
    found = getattr(module, name)
    globals()[name] = found
    return found
