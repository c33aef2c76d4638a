"""What a surface is made of: how it scatters, and from whom its numbers are. Lengths in micrometres.

    L_r = K_lm/pi E  +  (K_ss + K_s) F e^-g L_mirror  +  (K_sl + K_s) integral of F f_lobe L cos                       (18)

K_lm, K_ss and K_sl are the report's strengths of the three components, each alone. K_s is the strength of spike and lobe *together*:
e^-g already divides the light between the two, so that a metal that reflects everything has K_s = 1, while K_ss = K_sl = 1/2 would
lose half. Each of the four parts gives out at most what it receives, so energy is kept exactly when their sum is at most 1.
F is Fresnel's share at the facet for metals with known n and k, and 1 otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.errors import InputError, SceneError, told_of
from rangecheck.files import presets_folder, read_toml
from rangecheck.reflectance.energy import visibility_table
from rangecheck.reflectance.fast import lobe_table
from rangecheck.reflectance.fresnel import fresnel_table
from rangecheck.reflectance.lobe import FAST, MASKINGS, two_numbers
from rangecheck.reflectance.tables import (
    CORRELATION_UM,
    FORM,
    FRESNEL,
    K_LM,
    K_LOBE,
    K_SPIKE,
    MASKING,
    REACH,
    ROUGHNESS,
    SIGMA_UM,
    SURFACE_LENGTH,
    VISIBILITY,
    WAVELENGTH_UM,
    MaterialTables,
)

#: red, green and blue where a scene is in colour, the report's single wavelength where it is grey
COLOUR_UM = (0.65, 0.55, 0.45)
GREY_UM = (0.555,)


@dataclass(frozen=True)
class Material:
    """A surface's reflectance; see the module for the meaning of the strengths K.

    name, description   for people
    K_lm, K_ss, K_sl, K_s  in 0..1, each one number or one per wavelength; their sum is at most 1 at every wavelength
    sigma_um            standard deviation of height, >= 0
    correlation_um      correlation length T, > 0
    wavelengths_um      at which the material is evaluated
    index_um, n, k      measured refractive index n + i k at the wavelengths `index_um`; empty for a perfect conductor
    source              where the numbers are from
    masking             none, smith or v-groove
    bounded             keep lobe + spike within 1 at every angle
    stated              how well the numbers are known, in lines for people, where a fit says so

    Raises SceneError for numbers outside these ranges.
    """

    name: str
    K_lm: float | tuple[float, ...] = 0.0
    K_ss: float | tuple[float, ...] = 0.0
    K_sl: float | tuple[float, ...] = 0.0
    K_s: float | tuple[float, ...] = 0.0
    sigma_um: float = 0.0
    correlation_um: float = 1.0
    wavelengths_um: tuple[float, ...] = COLOUR_UM
    index_um: tuple[float, ...] = field(default=(), repr=False)
    n: tuple[float, ...] = field(default=(), repr=False)
    k: tuple[float, ...] = field(default=(), repr=False)
    masking: str = "smith"
    bounded: bool = True
    description: str = field(default="", repr=False)
    source: str = field(default="", repr=False)
    stated: tuple[str, ...] = field(default=(), repr=False)

    def __post_init__(self) -> None:
        if not self.wavelengths_um or not all(0.0 < w < math.inf for w in self.wavelengths_um):
            raise SceneError(f"{self.name}: wavelengths_um is {self.wavelengths_um}; it needs lengths above 0, such as 0.555")
        if self.masking not in MASKINGS:
            raise SceneError(f"{self.name}: masking is {self.masking!r}; it must be one of {', '.join(MASKINGS)}")
        if not 0.0 <= self.sigma_um < math.inf or not 0.0 < self.correlation_um < math.inf:
            raise SceneError(
                f"{self.name}: sigma_um is {self.sigma_um}, correlation_um {self.correlation_um}; "
                "heights need sigma_um >= 0 and correlation_um > 0, in micrometres"
            )
        strengths = self.strengths()
        if not (np.isfinite(strengths).all() and (strengths >= 0.0).all()):
            raise SceneError(f"{self.name}: strengths K must be 0 or more; they are {strengths.tolist()}")
        most = float(strengths.sum(axis=0).max())
        if most > 1.0 + 1e-12:
            raise SceneError(
                f"{self.name}: K_lm + K_ss + K_sl + K_s is {most:.6g}; more than 1 makes light from nothing; "
                "lower them, or give spike and lobe together one K_s",
                total=most,
            )
        if not len(self.index_um) == len(self.n) == len(self.k) or list(self.index_um) != sorted(set(self.index_um)):
            raise SceneError(f"{self.name}: index_um, n and k must be equally long, with index_um rising")
        if any(not v > 0.0 for v in self.n) or any(not v >= 0.0 for v in self.k):
            raise SceneError(f"{self.name}: a refractive index needs n > 0 and k >= 0")
        for w in self.wavelengths_um if self.index_um else ():
            if not self.index_um[0] <= w <= self.index_um[-1]:
                raise SceneError(
                    f"{self.name}: n and k are known from {self.index_um[0]} to {self.index_um[-1]} um, not at {w} um; "
                    "choose wavelengths inside that range"
                )

    def _repr_html_(self) -> str:
        """A notebook's look at the material: figure 3's polar plots of its components."""
        from rangecheck.reflectance.charts import polar_chart

        return polar_chart(self).decode()

    def strengths(self) -> FloatArray:
        """(4, wavelengths) K_lm, K_ss, K_sl, K_s. Raises SceneError where one has another number of values."""
        count = len(self.wavelengths_um)
        rows = []
        for key in ("K_lm", "K_ss", "K_sl", "K_s"):
            try:
                values = np.atleast_1d(np.asarray(getattr(self, key), dtype=np.float64))
            except (TypeError, ValueError):
                raise SceneError(f"{self.name}: {key} is {getattr(self, key)!r}; a strength is a number in 0..1") from None
            if values.shape not in ((1,), (count,)):
                raise SceneError(f"{self.name}: {key} has {values.size} values for {count} wavelengths; give one or {count}")
            rows.append(np.broadcast_to(values, (count,)))
        return np.array(rows)

    def index_at(self, wavelength_um: float) -> tuple[float, float] | tuple[None, None]:
        """(n, k) at a wavelength, linear between the measured ones; (None, None) for a perfect conductor."""
        if not self.index_um:
            return None, None
        return float(np.interp(wavelength_um, self.index_um, self.n)), float(np.interp(wavelength_um, self.index_um, self.k))

    def at(self, wavelengths_um: Sequence[float]) -> Material:
        """The same surface at other wavelengths; strengths given per wavelength are interpolated, and held beyond the ends."""
        order = np.argsort(self.wavelengths_um)
        known = np.asarray(self.wavelengths_um)[order]
        moved = {
            key: tuple(float(v) for v in np.interp(wavelengths_um, known, row[order]))
            for key, row in zip(("K_lm", "K_ss", "K_sl", "K_s"), self.strengths())
        }
        return replace(self, wavelengths_um=tuple(float(w) for w in wavelengths_um), **moved)  # type: ignore[arg-type]

    def concerns(self) -> tuple[str, ...]:
        """Where the model is used outside its assumptions, in words; empty where it is not."""
        if not self.strengths()[1:].any():
            return ()
        shortest = min(self.wavelengths_um)
        found = []
        if self.correlation_um < max(self.wavelengths_um):
            found.append(
                f"correlation_um {self.correlation_um:g} is below the wavelength {max(self.wavelengths_um):g}: "
                "the scattering theory needs curvature radii far above the wavelength"
            )
        if self.sigma_um > 0.5 * self.correlation_um:
            found.append(
                f"rms slope {2 * self.sigma_um / self.correlation_um:.2f} is above 1: facets would shade each other repeatedly"
            )
        if self.sigma_um == 0.0 and self.strengths()[2].any():
            found.append("sigma_um is 0, so the lobe is empty and K_sl reflects nothing")
        if (4 * math.pi * self.sigma_um / shortest) ** 2 > 1e8:
            found.append(f"sigma_um {self.sigma_um:g} is so many wavelengths that geometry should carry the roughness")
        return tuple(found)

    def tables(self) -> MaterialTables:
        """This material alone, as index 0 of a stack."""
        return stack_tables([self])


def side_by_side(materials: Sequence[Material]) -> tuple[Material, ...]:
    """The same surfaces, all at the wavelengths of the one that is given at most (the first of those), so that one scene may hold them."""
    if len({material.wavelengths_um for material in materials}) < 2:
        return tuple(materials)
    waves = max(materials, key=lambda material: len(material.wavelengths_um)).wavelengths_um
    return tuple(material if material.wavelengths_um == waves else material.at(waves) for material in materials)


def stack_tables(materials: Sequence[Material]) -> MaterialTables:
    """`materials` side by side, in order, for a tracer. Raises SceneError if their wavelengths differ or there is none.

    Bounds are solved once per surface and wavelength and remembered: about a second each on first use, nothing after."""
    if not materials:
        raise SceneError("a scene needs at least one material")
    waves = materials[0].wavelengths_um
    for material in materials:
        if material.wavelengths_um != waves:
            raise SceneError(
                f"{material.name} is given at {material.wavelengths_um} um and {materials[0].name} at {waves} um; "
                "evaluate them at the same wavelengths with Material.at()"
            )
    surfaces = np.zeros((len(materials), len(waves), SURFACE_LENGTH))
    for m, material in enumerate(materials):
        k_lm, k_ss, k_sl, k_s = material.strengths()
        masking = MASKINGS[material.masking]
        for w, wavelength in enumerate(waves):
            roughness, reach = two_numbers(material.sigma_um, material.correlation_um, wavelength)
            lobe = k_sl[w] + k_s[w]
            row = surfaces[m, w]
            row[K_LM], row[K_SPIKE], row[K_LOBE] = k_lm[w], k_ss[w] + k_s[w], lobe
            row[ROUGHNESS], row[REACH], row[MASKING] = roughness, reach, masking
            row[SIGMA_UM], row[CORRELATION_UM], row[WAVELENGTH_UM] = material.sigma_um, material.correlation_um, wavelength
            row[FORM] = FAST
            row[VISIBILITY:FRESNEL] = visibility_table(roughness, reach, masking, material.bounded and lobe > 0.0)
            row[FRESNEL:] = _fresnel_table(*material.index_at(wavelength))
    surfaces.flags.writeable = False
    # matt surfaces have no lobe to look up, and need not wait for the table; read-only like it, so that stages are compiled once
    none = np.zeros((0, 0, 0))
    none.flags.writeable = False
    return MaterialTables(surfaces, lobe_table() if (surfaces[..., K_LOBE] > 0).any() else none)


_fresnel_table = lru_cache(maxsize=256)(fresnel_table)


def material_names() -> list[str]:
    """Names of the shipped materials, sorted."""
    return sorted(path.stem for path in (presets_folder() / "materials").glob("*.toml"))


def load_material(name_or_path: str | Path) -> Material:
    """A shipped material by name, or one from a TOML file. Raises InputError naming what ships, or the bad key."""
    path = Path(name_or_path)
    if path.suffix != ".toml":
        shipped = material_names()
        if str(name_or_path) not in shipped:
            raise InputError(
                name_or_path, f"is no shipped material; choose one of {', '.join(shipped)}, or a .toml file", shipped=shipped
            )
        path = presets_folder() / "materials" / f"{name_or_path}.toml"
    with told_of(path):
        return _material_from(path, read_toml(path))


_NUMBERS = ("K_lm", "K_ss", "K_sl", "K_s")
_KEYS = (
    *_NUMBERS,
    "sigma_um",
    "correlation_um",
    "wavelengths_um",
    "masking",
    "bounded",
    "description",
    "source",
    "index",
    "uncertainty",
)
_INDEX_KEYS = ("wavelengths_um", "n", "k", "source")


def _material_from(path: Path, document: dict[str, Any]) -> Material:
    values = dict(document)
    index = values.pop("index", {})
    if not isinstance(index, dict):
        raise InputError(path, f"its index is {index!r}; it must be a table with {', '.join(_INDEX_KEYS)}")
    # what a fit says of its own numbers is for people and programs, not for light
    uncertainty = values.pop("uncertainty", {})
    unknown = [key for key in document if key not in _KEYS] + [f"index.{key}" for key in index if key not in _INDEX_KEYS]
    if unknown:
        raise InputError(path, f"unknown key {unknown[0]}; a material has {', '.join(_KEYS)}", unknown=unknown)
    for key in (*_NUMBERS, "wavelengths_um"):
        if isinstance(values.get(key), list):
            values[key] = tuple(values[key])
    sources = [text for text in (values.get("source", ""), index.get("source", "")) if text != ""]
    if not all(isinstance(text, str) for text in sources):
        raise InputError(path, f"its source is {sources[0]!r}; it must be text")
    values["source"] = "; ".join(sources)
    try:
        if index:
            values.update(index_um=tuple(index["wavelengths_um"]), n=tuple(index["n"]), k=tuple(index["k"]))
        material = Material(name=path.stem, **values)
    except (TypeError, KeyError, OverflowError) as error:
        raise InputError(path, f"does not describe a material ({error})") from None
    except SceneError as error:
        raise InputError(path, str(error), **error.measured) from None
    return replace(material, stated=_stated(path, material, uncertainty)) if uncertainty != {} else material


def _stated(path: Path, material: Material, uncertainty: Any) -> tuple[str, ...]:
    """What a fit's table `uncertainty` says, in lines: 95 % intervals beside the numbers that they are of, and what is not determined."""
    known = {"K_lm": ("K_lm",), "K_spike": ("K_ss", "K_s"), "K_lobe": ("K_sl", "K_s")}
    try:
        residual, missing = float(uncertainty["residual_in_noises"]), [str(said) for said in uncertainty["not_determined"]]
        numbers = []
        for name, interval in uncertainty.items():
            if name in ("residual_in_noises", "not_determined"):
                continue
            value = sum(float(np.max(getattr(material, key))) for key in known.get(name, (name,)))
            low_high = f"{interval[0]:.4g} to {interval[1]:.4g}" if interval else "not determined"
            numbers.append(f"{name} {value:.4g} ({low_high})")
    except (TypeError, KeyError, ValueError, AttributeError, IndexError) as error:
        raise InputError(
            path,
            f"its uncertainty cannot be read ({error}); a fit writes residual_in_noises, not_determined and [low, high] of each number",
        ) from None
    fitted = f"fitted to pictures, with 95 % intervals: {', '.join(numbers)}; residuals {residual:.4g} times the noise"
    return (fitted, *(f"not determined: {said}" for said in missing))
