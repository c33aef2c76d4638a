"""What varies from picture to picture: ranges in TOML, and the draw of picture k, a pure function of (seed, k).

A range [low, high] is drawn from evenly; equal ends fix a value. Azimuth 0 looks at the object from +z, growing towards +x; lights' azimuths
count from the camera's. Lengths are shares of the object's extent.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.errors import SettingError
from rangecheck.files import presets_folder, read_toml

Range = tuple[float, float]

#: every range with its default and what it may not leave
_LIMITS: dict[str, dict[str, tuple[Range, Range]]] = {
    "camera": {
        "azimuth_deg": ((-180, 180), (-360, 360)),
        "elevation_deg": ((-15, 50), (-85, 85)),
        "roll_deg": ((-8, 8), (-180, 180)),
        "field_of_view_deg": ((18, 40), (2, 120)),
        "fill": ((0.55, 0.9), (0.05, 4)),
        "aside": ((0, 0.08), (0, 2)),
    },
    "light": {
        "sources": ((1, 3), (0, 16)),
        "irradiance": ((0.3, 1), (0, 1e6)),
        "azimuth_deg": ((-90, 90), (-360, 360)),
        "elevation_deg": ((0, 70), (-90, 90)),
        "radius_deg": ((1, 6), (0.01, 20)),
        "below": ((0.02, 0.1), (0, 1e6)),
        "above": ((0.1, 0.4), (0, 1e6)),
    },
    "material": {"albedo": ((0.4, 0.95), (0, 1))},
    "sensor": {
        "full_well": ((5000, 40000), (10, 1e9)),
        "read_noise": ((2, 15), (0, 1e6)),
        "exposure_stops": ((-0.7, 0.5), (-10, 10)),
    },
}


@dataclass(frozen=True)
class Lamp:
    """One source of a sample."""

    irradiance: float
    azimuth_deg: float
    elevation_deg: float
    radius_deg: float


@dataclass(frozen=True)
class Sample:
    """The parameters of one picture."""

    azimuth_deg: float
    elevation_deg: float
    roll_deg: float
    field_of_view_deg: float
    fill: float
    aside: tuple[float, float]
    lamps: tuple[Lamp, ...]
    below: float
    above: float
    material: str
    albedo: float
    full_well: float
    read_noise: float
    exposure_stops: float

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        found = {f.name: getattr(self, f.name) for f in fields(self)}
        return found | {"aside": list(self.aside), "lamps": [vars(lamp) for lamp in self.lamps]}


@dataclass(frozen=True)
class Ranges:
    """`of["section.name"]` is (low, high); materials are drawn from `names`."""

    of: Mapping[str, Range]
    names: tuple[str, ...]

    def draw(self, seed: int, index: int) -> Sample:
        """The parameters of picture `index`."""
        rng = np.random.default_rng([seed, index])

        def one(name: str) -> float:
            low, high = self.of[name]
            return float(rng.uniform(low, high)) if high > low else float(low)

        camera = [one(f"camera.{n}") for n in ("azimuth_deg", "elevation_deg", "roll_deg", "field_of_view_deg", "fill")]
        reach, way = one("camera.aside"), float(rng.uniform(0, 2 * math.pi))
        lamps = tuple(
            Lamp(*(one(f"light.{n}") for n in ("irradiance", "azimuth_deg", "elevation_deg", "radius_deg")))
            for _ in range(round(one("light.sources")))
        )
        below, above = one("light.below"), one("light.above")
        material = self.names[int(rng.integers(len(self.names)))]
        albedo = one("material.albedo")
        sensor = [one(f"sensor.{n}") for n in ("full_well", "read_noise", "exposure_stops")]
        aside = (reach * math.cos(way), reach * math.sin(way))
        return Sample(
            camera[0], camera[1], camera[2], camera[3], camera[4], aside, lamps, below, above, material, albedo,
            sensor[0], sensor[1], sensor[2],
        )  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return {"ranges": {name: list(ends) for name, ends in self.of.items()}, "materials": list(self.names)}


def read_ranges(file: str | Path | None = None) -> Ranges:
    """The ranges of a TOML file, or of a preset of configs/datasets; what it leaves out has the default. Raises InputError, SettingError."""
    path = presets_folder() / "datasets" / "default.toml" if file is None else Path(file)
    if path.suffix != ".toml" and not path.exists():
        path = presets_folder() / "datasets" / f"{file}.toml"
    document = read_toml(path)
    names = ["plaster"]
    found = {f"{part}.{name}": default for part, names_ in _LIMITS.items() for name, (default, _) in names_.items()}
    for part, rows in document.items():
        if part not in _LIMITS or not isinstance(rows, dict):
            raise SettingError(f"{path}: [{part}] is unknown; there are {', '.join(_LIMITS)}", key=part)
        for name, value in rows.items():
            if (part, name) == ("material", "names"):
                if not isinstance(value, list) or not value or not all(isinstance(n, str) for n in value):
                    raise SettingError(
                        f"{path}: material.names is {value!r}; it must be a list of materials", key="material.names"
                    )
                names = value
                continue
            if name not in _LIMITS[part]:
                near = difflib.get_close_matches(name, _LIMITS[part], n=1)
                hint = f"did you mean {part}.{near[0]}?" if near else f"known are {', '.join(_LIMITS[part])}"
                raise SettingError(f"{path}: {part}.{name} is unknown; {hint}", key=f"{part}.{name}")
            found[f"{part}.{name}"] = _range(value, f"{path}: {part}.{name}", _LIMITS[part][name][1])
    return Ranges(found, tuple(names))


def _range(value: Any, where: str, limits: Range) -> Range:
    low, high = limits
    numbers = value if isinstance(value, list) else [value, value]
    if (
        len(numbers) != 2
        or not all(isinstance(n, (int, float)) and not isinstance(n, bool) for n in numbers)
        or not low <= numbers[0] <= numbers[1] <= high
    ):
        raise SettingError(f"{where} is {value!r}; it must be [low, high] between {low:g} and {high:g}", key=where.split()[-1])
    return float(numbers[0]), float(numbers[1])
