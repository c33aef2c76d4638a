"""One verdict of a job: what is said of the solid, of its scans and of its likeness, the worst first, in one sentence.

The solid's word decides whether an STL is written and the exit status; scans and likeness say what to expect of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rangecheck.solid import Verdict

#: how bad a word is
_WORDS = ("fit", "accurate enough", "fit with reservations", "not accurate enough", "unfit", "not fit")


def verdicts_of(judged: Verdict, quality: Mapping[str, Any] | None, likeness: Mapping[str, Any]) -> list[dict[str, str]]:
    """`about` (solid, scans, likeness), `word` and `why` of each, the worst first, the solid before others that are as bad."""
    rows = [{"about": "solid", "word": "fit" if judged.fit else "not fit", "why": judged.sentence()}]
    if quality is not None:
        worst = next((f["text"] for level in ("error", "warning") for f in quality["findings"] if f["severity"] == level), "")
        rows.append({"about": f"scans for {quality['profile']['name']}", "word": quality["verdict"], "why": worst})
    word = "accurate enough" if likeness["fit"] else "not accurate enough"
    rows.append({"about": "likeness where it was seen", "word": word, "why": likeness["verdict"].partition(": ")[2]})
    return sorted(rows, key=lambda row: -_WORDS.index(row["word"]))


def sentence_of(rows: list[dict[str, str]]) -> str:
    """All verdicts in one sentence, with the reason of the worst."""
    said = "; ".join(f"{row['about']}: {row['word']}" for row in rows)
    return f"{said} ({rows[0]['why']})" if rows[0]["why"] else said
