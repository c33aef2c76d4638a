"""What the presets' cells cost and gain, as `rangecheck study job` measured it; shipped as configs/measured.toml."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from typing import Any

from rangecheck.config import Settings, load_settings
from rangecheck.files import presets_folder, read_bytes
from rangecheck.pipeline.outcome import Outcome

#: from the quickest to the finest
PRESETS = ("quick", "normal", "fine")


def measured() -> dict[str, Any]:
    """The machine and scans (`on`), and of each preset seconds (scans to solid), rms_mm, p99_mm, faces."""
    return tomllib.loads(read_bytes(presets_folder() / "measured.toml").decode())


def finer_than(settings: Settings) -> str | None:
    """What the next finer preset would gain over settings that fuse as finely as a preset; None where there is none to compare with."""
    cells = {name: load_settings(name).meshing.voxel_in_spacings for name in PRESETS}
    if settings.meshing.voxel_mm is not None or settings.meshing.voxel_in_spacings not in cells.values():
        return None
    own = next(name for name in PRESETS if cells[name] == settings.meshing.voxel_in_spacings)
    if own == PRESETS[-1]:
        return "cells as in preset fine, the finest; rangecheck study job --part cells charts what cells cost and gain"
    finer = PRESETS[PRESETS.index(own) + 1]
    found = measured()
    a, b = found[own], found[finer]
    return (
        f"cells as in preset {own}; those of --preset {finer} lowered the error from {a['rms_mm']:.3f} to {b['rms_mm']:.3f} mm RMS and took "
        f"{b['seconds']:.0f} s instead of {a['seconds']:.0f} from scans to solid ({found['on']}: rangecheck study job)"
    )


def with_gain(outcome: Outcome, settings: Settings) -> Outcome:
    """A job's outcome, saying what a finer preset would gain where its surface was fused."""
    said = finer_than(settings) if outcome.document.get("method") == "fuse" else None
    return outcome if said is None else replace(outcome, lines=[*outcome.lines, said])
