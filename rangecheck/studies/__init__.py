"""Studies of the stages: which methods, at which settings, against which truth. `rangecheck.study` measures and draws them."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

from rangecheck.errors import SettingError

if TYPE_CHECKING:
    from rangecheck.study import Study

#: every study by name, and the module whose `study(quick, part)` makes it
STUDIES = {
    "checking": "rangecheck.studies.checking",
    "fit": "rangecheck.studies.fit",
    "hardness": "rangecheck.studies.hardness",
    "consistency": "rangecheck.studies.consistency",
    "pictures": "rangecheck.studies.pictures",
    "meshing": "rangecheck.studies.meshing",
    "reflectance": "rangecheck.studies.reflectance",
    "registration": "rangecheck.studies.registration",
    "scans": "rangecheck.studies.scans",
    "transport": "rangecheck.studies.transport",
    "rays": "rangecheck.studies.rays",
    "repair": "rangecheck.studies.repair",
    "renderers": "rangecheck.studies.renderers",
}


def study_named(name: str, part: str | None = None, others: Sequence[str] = ()) -> Callable[..., Study]:
    """The function `study(quick=False) -> Study` of that name, or of one of its parts. Raises SettingError naming those that exist, here
    and among `others`, which the caller knows."""
    if name not in STUDIES:
        near = difflib.get_close_matches(name, [*STUDIES, *others], n=1)
        hint = f"did you mean {near[0]}?" if near else f"choose one of {', '.join([*STUDIES, *others])}"
        raise SettingError(f"there is no study {name!r}; {hint}", key=name)
    module = importlib.import_module(STUDIES[name])
    if part is None:
        made: Callable[..., Study] = module.study
        return made
    parts = getattr(module, "PARTS", ())
    if part not in parts:
        said = f"its parts are {', '.join(parts)}" if parts else "it is made as a whole"
        raise SettingError(f"the study {name!r} has no part {part!r}; {said}", key=part)
    return partial(module.study, part=part)
