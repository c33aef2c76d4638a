"""From light to numbers: exposure, shot noise, read noise, response, quantisation.

EMVA Standard 1288: an irradiance lasting an exposure frees a mean number of electrons; their count is Poisson; the amplifier adds
Gaussian read noise; the well is finite; the response curve and the converter make a number of it. Every random number comes from
(seed, frame, pixel, draw) by a counter-based generator (Steele, Lea, Flood, *Fast splittable pseudorandom number generators*,
2014), so a picture is the same whole or in tiles, on any number of threads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import FloatArray, require
from rangecheck.errors import ArrayError, SettingError
from rangecheck.kernels import in_chunks, inline_kernel, kernel

RESPONSES = ("linear", "srgb", "gamma")
_PIXELS_PER_CHUNK = 65536


@dataclass(frozen=True)
class Sensor:
    """A camera's sensor.

    electrons_per_unit  mean electrons that one unit of image irradiance frees in one unit of time
    full_well           electrons at which a pixel saturates; it is the converter's largest number
    dark_electrons      mean electrons per unit of time without light
    read_noise          standard deviation of the amplifier, electrons
    bits                of the converter, 1 to 16; 0 keeps real numbers in 0..1
    response            linear, srgb, gamma (with `gamma`), or a monotone table of outputs 0..1 at even inputs 0..1
    """

    electrons_per_unit: float = 10_000.0
    full_well: float = 20_000.0
    dark_electrons: float = 0.0
    read_noise: float = 5.0
    bits: int = 8
    response: str | tuple[float, ...] = "linear"
    gamma: float = 2.2

    def __post_init__(self) -> None:
        for name, least in (
            ("electrons_per_unit", 1e-300),
            ("full_well", 1e-300),
            ("dark_electrons", 0.0),
            ("read_noise", 0.0),
            ("gamma", 1e-3),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= least):
                raise SettingError(
                    f"sensor's {name} is {value}; it must be a finite number of at least {least:g}", key=f"sensor.{name}"
                )
        if not 0 <= self.bits <= 16:
            raise SettingError(f"sensor's bits is {self.bits}; it must be 0 (real numbers) to 16", key="sensor.bits")
        if isinstance(self.response, str):
            if self.response not in RESPONSES:
                raise SettingError(
                    f"sensor's response is {self.response!r}; it must be {', '.join(RESPONSES)} or a table", key="sensor.response"
                )
        else:
            table = require("response", self.response, (None,), finite=True)
            if len(table) < 2 or (np.diff(table) < 0).any() or table.min() < 0 or table.max() > 1:
                raise SettingError("sensor's response table must grow from 0 to 1 in at least two steps", key="sensor.response")

    def mean_electrons(self, irradiance: FloatArray, exposure_time: float) -> FloatArray:
        """Expected electrons, dark current included, before the well is full."""
        return (self.electrons_per_unit * np.asarray(irradiance, np.float64) + self.dark_electrons) * exposure_time

    def electrons(self, irradiance: FloatArray, exposure_time: float = 1.0, *, seed: int = 0, frame: int = 0) -> FloatArray:
        """Electrons read out of each pixel (shape of `irradiance`), noise and saturation included, before the response.

        Raises ArrayError for negative or infinite irradiance; NaN (nothing seen) counts as dark."""
        light = np.nan_to_num(np.asarray(irradiance, np.float64), nan=0.0, posinf=np.inf)
        if (light < 0).any() or np.isinf(light).any():
            raise ArrayError("irradiance is negative or infinite somewhere; no light does that", name="irradiance")
        if not (math.isfinite(exposure_time) and exposure_time >= 0):
            raise ArrayError(f"exposure_time is {exposure_time}; it must be a time of at least 0", name="exposure_time")
        mean = np.ascontiguousarray(self.mean_electrons(light, exposure_time)).ravel()
        counted = np.empty_like(mean)

        def chunk(start: int, stop: int) -> None:
            _count(mean[start:stop], start, _mixed(seed, frame), self.read_noise, self.full_well, counted[start:stop])

        in_chunks(chunk, mean.size, _PIXELS_PER_CHUNK)
        return counted.reshape(light.shape)

    def expose(
        self, irradiance: FloatArray, exposure_time: float = 1.0, *, seed: int = 0, frame: int = 0
    ) -> npt.NDArray[np.generic]:
        """The picture: uint8 (up to 8 bits), uint16 (up to 16), or float64 in 0..1 (bits 0), of the shape of `irradiance`."""
        level = self.respond(self.electrons(irradiance, exposure_time, seed=seed, frame=frame) / self.full_well)
        if self.bits == 0:
            return level
        return np.rint(level * (2**self.bits - 1)).astype(np.uint8 if self.bits <= 8 else np.uint16)

    def respond(self, level: FloatArray) -> FloatArray:
        """Response curve: share of full well 0..1 to output 0..1."""
        x = np.clip(level, 0.0, 1.0)
        if self.response == "linear":
            return x
        if self.response == "srgb":
            return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
        if self.response == "gamma":
            return x ** (1 / self.gamma)
        return np.interp(x, np.linspace(0, 1, len(self.response)), np.asarray(self.response, dtype=float))

    def linearise(self, picture: npt.NDArray[np.generic]) -> FloatArray:
        """Share of full well 0..1 that each number of a picture stands for (inverse of response and quantisation)."""
        y = np.asarray(picture, np.float64) / (1.0 if self.bits == 0 else 2**self.bits - 1)
        if self.response == "linear":
            return y
        if self.response == "srgb":
            return np.where(y <= 0.04045, y / 12.92, ((y + 0.055) / 1.055) ** 2.4)
        if self.response == "gamma":
            return y**self.gamma
        return np.interp(y, np.asarray(self.response, dtype=float), np.linspace(0, 1, len(self.response)))


def _mixed(seed: int, frame: int) -> np.uint64:
    """One 64-bit stream number of seed and frame."""
    return np.random.SeedSequence([int(seed) & (2**64 - 1), int(frame)]).generate_state(1, np.uint64)[0]


@inline_kernel
def _uniform(stream, pixel, draw):
    """A number in (0, 1) for (stream, pixel, draw): SplitMix64's finaliser over two counters."""
    z = stream + np.uint64(pixel) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(1)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = (z ^ (z >> np.uint64(31))) + np.uint64(draw) * np.uint64(0xD1342543DE82EF95)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return (np.float64(z >> np.uint64(11)) + 0.5) * 1.1102230246251565e-16


@kernel
def _count(mean, first_pixel, stream, read_noise, full_well, counted):
    for i in range(mean.size):
        pixel = first_pixel + i
        draw = 2
        m = mean[i]
        if m < 10.0:
            # inversion: walk up the distribution
            target = _uniform(stream, pixel, draw)
            term = math.exp(-m)
            total, count = term, 0.0
            while target > total and count < 200.0:
                count += 1.0
                term *= m / count
                total += term
        else:
            # transformed rejection (Hormann, *The transformed rejection method for generating Poisson random variables*, 1993)
            b = 0.931 + 2.53 * math.sqrt(m)
            a = -0.059 + 0.02483 * b
            inverse_alpha = 1.1239 + 1.1328 / (b - 3.4)
            v_r = 0.9277 - 3.6224 / (b - 2.0)
            count = 0.0
            while True:
                u = _uniform(stream, pixel, draw) - 0.5
                v = _uniform(stream, pixel, draw + 1)
                draw += 2
                us = 0.5 - abs(u)
                count = math.floor((2.0 * a / us + b) * u + m + 0.43)
                if us >= 0.07 and v <= v_r:
                    break
                if count < 0.0 or (us < 0.013 and v > us):
                    continue
                if math.log(v * inverse_alpha / (a / (us * us) + b)) <= count * math.log(m) - m - math.lgamma(count + 1.0):
                    break
        # Box & Muller 1958
        radius = math.sqrt(-2.0 * math.log(_uniform(stream, pixel, 0)))
        gauss = radius * math.cos(2.0 * math.pi * _uniform(stream, pixel, 1))
        # the well fills before the amplifier adds its noise
        counted[i] = min(max(min(count, full_well) + read_noise * gauss, 0.0), full_well)
