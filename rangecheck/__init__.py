"""rangecheck: range scans of a head or sculpture in; a checked, physically rendered bust and its STL out.

    import rangecheck as rc
    scans = rc.read_scans("sample_data")
    surface = rc.mesh_scans(scans, "fuse")
    rc.check_solid(surface).findings
    rc.render(surface, "steel")

The names here are loaded when first used; every room below has more.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rangecheck.pipeline.easy import render, run
    from rangecheck.reflectance.material import load_material
    from rangecheck.scan.range_scan import RangeScan
    from rangecheck.scan.readers import read_scans
    from rangecheck.solid.solid import Solid, check_solid
    from rangecheck.surface.mesh_files import read_mesh
    from rangecheck.surface.meshing import mesh_scans
    from rangecheck.surface.surface import Surface

__version__ = "0.1.0"

_WHERE = {
    "RangeScan": "scan.range_scan",
    "Solid": "solid.solid",
    "Surface": "surface.surface",
    "check_solid": "solid.solid",
    "load_material": "reflectance.material",
    "mesh_scans": "surface.meshing",
    "read_mesh": "surface.mesh_files",
    "read_scans": "scan.readers",
    "render": "pipeline.easy",
    "run": "pipeline.easy",
}

__all__ = [
    "RangeScan",
    "Solid",
    "Surface",
    "check_solid",
    "load_material",
    "mesh_scans",
    "read_mesh",
    "read_scans",
    "render",
    "run",
]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"rangecheck has no {name!r}; it has {', '.join(__all__)}, and its rooms")
    found = getattr(importlib.import_module(f"rangecheck.{_WHERE[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
