"""What a printer can do: profiles as data among the presets (`printers/*.toml`), each number with its source beside it."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path

from rangecheck.errors import InputError, SettingError
from rangecheck.files import presets_folder, read_toml


@dataclass(frozen=True)
class Printer:
    """build_mm: width, depth, height. wall_mm: (sum of the part's sides up to, least wall) in ascending order. Lengths in mm, degrees from
    the horizontal; price in any currency, 0 where not stated."""

    name: str
    build_mm: tuple[float, float, float]
    pixel_mm: float
    layer_mm: float
    wall_mm: tuple[tuple[float, float], ...]
    feature_mm: float
    overhang_deg: float
    density_g_cm3: float
    price_per_litre: float

    def least_wall_mm(self, sum_of_sides_mm: float) -> float:
        """The thinnest wall allowed on a part whose box has this sum of sides."""
        for up_to, wall in self.wall_mm:
            if sum_of_sides_mm <= up_to:
                return wall
        return self.wall_mm[-1][1]


def printer_names() -> list[str]:
    """Names that `printer` knows."""
    return sorted(p.stem for p in (presets_folder() / "printers").glob("*.toml"))


def printer(name: str | Path) -> Printer:
    """A shipped profile by name, or one from a .toml file. Raises SettingError for unknown names and entries."""
    path = Path(name) if str(name).endswith(".toml") else presets_folder() / "printers" / f"{name}.toml"
    if not path.is_file():
        if path == Path(name):
            raise InputError(path, "does not exist; check the name")
        raise SettingError(
            f"no printer is called {str(name)!r}; known are {', '.join(printer_names())}, or give a .toml file", key="printer"
        )
    entries = read_toml(path)
    wanted = {f.name for f in fields(Printer)}
    if set(entries) != wanted:
        odd = sorted(set(entries) ^ wanted)
        raise SettingError(f"{path}: {', '.join(odd)} missing or unknown; a printer has {', '.join(sorted(wanted))}", key=odd[0])
    try:
        numbers = {k: float(v) for k, v in entries.items() if k not in ("name", "build_mm", "wall_mm")}
        build = tuple(float(x) for x in entries["build_mm"])
        walls = tuple((float(a), float(b)) for a, b in entries["wall_mm"])
        if (
            len(build) != 3
            or not walls
            or any(not (x > 0) for x in build)
            or any(not math.isfinite(x) or x < 0 for x in numbers.values())
        ):
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        raise SettingError(
            f"{path}: its numbers must be positive, build_mm three of them, wall_mm pairs", key="printer"
        ) from None
    return Printer(str(entries["name"]), (build[0], build[1], build[2]), wall_mm=walls, **numbers)
