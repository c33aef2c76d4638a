"""What a check found: each finding with its code, severity, count, places, why it matters and what mends it.

Codes and their texts are data (`findings.toml` among the presets), so that `explain` and reports say the same thing.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import SettingError
from rangecheck.files import presets_folder

SEVERITIES = ("note", "warning", "error")
#: places kept with a finding; its count is exact whatever their number
PLACES_KEPT = 200
#: findings about what a surface was made of: it may be a solid all the same
ABOUT_SCANS = ("too-much-invented",)


@dataclass(frozen=True)
class Explanation:
    """What a code means."""

    code: str
    severity: str
    title: str
    why: str
    mend: str


@cache
def catalogue() -> Mapping[str, Explanation]:
    """All codes with their default severity and texts."""
    with (presets_folder() / "findings.toml").open("rb") as stream:
        return {code: Explanation(code, **entry) for code, entry in tomllib.load(stream).items()}


def explain(code: str) -> Explanation:
    """The meaning of one code. Raises SettingError, with the nearest known code, for another word."""
    try:
        return catalogue()[code]
    except KeyError:
        from difflib import get_close_matches

        near = get_close_matches(code, catalogue(), 1)
        hint = f"; did you mean {near[0]}?" if near else f"; known are {', '.join(catalogue())}"
        raise SettingError(f"no finding has the code {code!r}{hint}", key=code) from None


@dataclass(frozen=True, eq=False)
class Finding:
    """One kind of defect.

    code, severity   see `catalogue`
    count            how many there are
    message          one sentence with the numbers
    places_mm        (k, 3) where, at most PLACES_KEPT of them, evenly taken
    faces            (k,) faces involved, all of them
    why, mend        why it matters, what mends it
    measured         further numbers, JSON-ready
    """

    code: str
    severity: str
    count: int
    message: str
    places_mm: FloatArray = field(repr=False)
    faces: IntArray = field(repr=False)
    why: str = field(repr=False)
    mend: str = field(repr=False)
    measured: Mapping[str, Any] = field(default_factory=dict)

    def to_dict(self, faces: int = PLACES_KEPT) -> dict[str, Any]:
        """JSON-ready, with at most `faces` face numbers."""
        return {
            "code": self.code,
            "severity": self.severity,
            "count": self.count,
            "message": self.message,
            "places_mm": [[round(x, 6) for x in p] for p in self.places_mm.tolist()],
            "faces": _evenly(self.faces, faces).tolist(),
            "why": self.why,
            "mend": self.mend,
            **self.measured,
        }


def finding(
    code: str,
    count: int,
    message: str,
    places_mm: FloatArray | None = None,
    faces: IntArray | None = None,
    severities: Mapping[str, str] | None = None,
    **measured: Any,
) -> Finding:
    """A finding of the catalogue; `severities` overrides default severities by code."""
    text = explain(code)
    places = np.empty((0, 3)) if places_mm is None else np.asarray(places_mm, np.float64).reshape(-1, 3)
    return Finding(
        code=code,
        severity=(severities or {}).get(code, text.severity),
        count=int(count),
        message=message,
        places_mm=_evenly(places, PLACES_KEPT),
        faces=np.empty(0, np.int32) if faces is None else np.asarray(faces, np.int32),
        why=text.why,
        mend=text.mend,
        measured=measured,
    )


def _evenly(rows: Any, most: int) -> Any:
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).astype(int)]


@dataclass(frozen=True, eq=False)
class Verdict:
    """All findings, worst first, and the facts that were measured on the way (JSON-ready)."""

    findings: tuple[Finding, ...]
    facts: Mapping[str, Any]

    @property
    def errors(self) -> tuple[Finding, ...]:
        """Findings that keep the surface from being what was asked of it."""
        return tuple(f for f in self.findings if f.severity == "error")

    @property
    def fit(self) -> bool:
        """Whether no finding is an error."""
        return not self.errors

    def has(self, code: str) -> bool:
        """Whether something with this code was found."""
        return any(f.code == code for f in self.findings)

    def get(self, code: str) -> Finding:
        """The finding with this code; KeyError when there is none."""
        for item in self.findings:
            if item.code == code:
                return item
        raise KeyError(code)

    def sentence(self) -> str:
        """One line: solid, or the errors in the order of their weight; what is solid but held back for its scans' sake is said to be so."""
        if self.fit:
            return f"solid: closed, manifold, oriented, {self.facts['volume_mm3'] / 1000:.2f} cm3"
        word = "solid, but not fit: " if all(f.code in ABOUT_SCANS for f in self.errors) else "not solid: "
        return word + "; ".join(f.message for f in self.errors)

    def lines(self) -> list[str]:
        """For people: the sentence, then each finding with a place and what mends it."""
        lines = [self.sentence()]
        for found in self.findings:
            place = ""
            if len(found.places_mm):
                place = (
                    " at "
                    + ", ".join(f"{x:.2f}" for x in found.places_mm[0])
                    + " mm"
                    + (" and elsewhere" if found.count > 1 else "")
                )
            lines.append(f"  {found.severity:<8} {found.code}: {found.message}{place}")
            lines.append(f"           mend: {found.mend}")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return {
            "fit": self.fit,
            "sentence": self.sentence(),
            "facts": dict(self.facts),
            "findings": [f.to_dict() for f in self.findings],
        }


def verdict(findings: list[Finding], facts: Mapping[str, Any]) -> Verdict:
    """Findings put in order: errors first, each kind in the order it was looked for."""
    return Verdict(tuple(sorted(findings, key=lambda f: -SEVERITIES.index(f.severity))), facts)
