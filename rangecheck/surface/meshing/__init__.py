"""From scans to a surface: one file per method, one signature."""

from rangecheck.surface.meshing.choose import METHODS, choose_method, mesh_scans
from rangecheck.surface.meshing.fuse import fuse
from rangecheck.surface.meshing.grid import grid_mesh
from rangecheck.surface.meshing.openings import opened
from rangecheck.surface.meshing.pivot import pivot
from rangecheck.surface.meshing.poisson import poisson

__all__ = ["METHODS", "choose_method", "fuse", "grid_mesh", "mesh_scans", "opened", "pivot", "poisson"]
