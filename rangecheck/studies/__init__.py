"""Studies of the stages: which methods, at which settings, against which truth. `rangecheck.study` measures and draws them."""

from __future__ import annotations

import importlib
from collections.abc import Callable

from rangecheck.errors import SettingError
from rangecheck.study import Study

#: every study by name, and the module whose `study(quick)` makes it
STUDIES = {"reflectance": "rangecheck.studies.reflectance"}


def study_named(name: str) -> Callable[..., Study]:
    """The function `study(quick=False) -> Study` of that name. Raises SettingError naming those that exist."""
    if name not in STUDIES:
        raise SettingError(f"there is no study {name!r}; choose one of {', '.join(STUDIES)}", key=name)
    return importlib.import_module(STUDIES[name]).study
