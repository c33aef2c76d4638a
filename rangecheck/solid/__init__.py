"""Solids: what a stereolithography printer can build. A `Solid` cannot exist unless every check passed."""

from rangecheck.solid.findings import Finding, Verdict, explain
from rangecheck.solid.solid import Solid, check_solid

__all__ = ["Finding", "Solid", "Verdict", "check_solid", "explain"]
