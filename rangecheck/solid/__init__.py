"""Solids: what a stereolithography printer can build. A `Solid` cannot exist unless every check passed."""

from rangecheck.solid.base import choose_base_height, cut_flat
from rangecheck.solid.findings import Finding, Verdict, explain, finding, verdict
from rangecheck.solid.relief import close_relief
from rangecheck.solid.repair import Repaired, repair
from rangecheck.solid.solid import Solid, check_solid
from rangecheck.solid.untangle import untangle

__all__ = [
    "Finding",
    "Repaired",
    "Solid",
    "Verdict",
    "check_solid",
    "choose_base_height",
    "close_relief",
    "cut_flat",
    "explain",
    "finding",
    "repair",
    "untangle",
    "verdict",
]
