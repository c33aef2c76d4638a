"""The reflectance model as functions of angles, for whole arrays: what notebooks, tests and charts call.

Angles in radians: theta_i, theta_r from the normal in 0..pi/2, phi the azimuth of the reflected direction with phi = 0 forward, so
that phi = 0 and theta_r = theta_i is the mirror direction. Lengths in micrometres. Strength K = 1 and Fresnel's share F = 1: a perfect
conductor, as in CMU-RI-TR-91-16. All inputs broadcast; results are float64. `sampling` and `tables` hold the compiled forms.
"""

from __future__ import annotations

import math
import warnings
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import FloatArray, IntArray, require
from rangecheck.errors import ArrayError
from rangecheck.kernels import in_chunks, inline_kernel, kernel
from rangecheck.reflectance.energy import VISIBILITY_OCTAVES, lobe_albedo, rms_slope_of, visibility_table
from rangecheck.reflectance.fast import lobe_table
from rangecheck.reflectance.lobe import (
    FAST,
    FORMS,
    MASKINGS,
    SMITH,
    UNMASKED,
    V_GROOVE,
    lobe_geometry,
    scattering_sum,
    smith_masking,
    two_numbers,
    v_groove_masking,
)
from rangecheck.reflectance.many import fill_fast
from rangecheck.reflectance.octaves import value_at
from rangecheck.reflectance.sampling import scattered_direction, scattering_order
from rangecheck.reflectance.series import log_lobe_series

_CHUNK, _CHUNK_FAST = 4096, 32768
#: azimuths beyond this (radians) are brought back to one turn first
_MANY_TURNS = 1e4


class KirchhoffWarning(UserWarning):
    """The correlation length is below the wavelength, where the scattering theory's assumption of gentle curvature fails."""


def lobe_brdf(
    theta_i: npt.ArrayLike,
    theta_r: npt.ArrayLike,
    phi: npt.ArrayLike,
    *,
    sigma_um: npt.ArrayLike,
    correlation_um: npt.ArrayLike,
    wavelength_um: npt.ArrayLike,
    form: str = "series",
    masking: str = "none",
    bounded: bool = False,
) -> FloatArray:
    """The specular lobe's BRDF in sr^-1, (1), (6), (7), (13).

    form    series  the general form, within 1e-9 relative wherever S exceeds 1e-290
            fast    the tracer's table, within `fast.FAST_ERROR` of it
            smooth  (6), for g << 1;   rough  (7), (13), for g >> 1
    masking none, smith or v-groove
    bounded also scaled so that lobe + spike never exceeds 1 (see energy.py)

    The defaults are the published model, which creates energy past about 75 degrees. Symmetric in theta_i and theta_r.
    Raises ArrayError for angles outside 0..pi/2, NaN, sigma_um < 0 or lengths not above 0. Warns KirchhoffWarning where
    correlation_um < wavelength_um."""
    form_number, masking_number = _choice("form", form, FORMS), _choice("masking", masking, MASKINGS)
    lengths = _lengths(sigma_um, correlation_um, wavelength_um)
    azimuth = _azimuth(phi)
    given = (_polar("theta_i", theta_i), _polar("theta_r", theta_r), azimuth, *two_numbers(*lengths))
    shape = np.broadcast_shapes(*(np.shape(values) for values in given))
    # a single value serves all without being spread
    flat = [(a if np.size(a) == 1 or np.shape(a) == shape else np.broadcast_to(a, shape).copy()).reshape(-1) for a in given]
    masks = masking_number != UNMASKED or bounded
    roughness, reach = np.broadcast_arrays(flat[3], flat[4])
    surface, seen = _visibilities(roughness, reach, masking_number, bounded)
    out = np.empty(shape).reshape(-1)
    if form_number == FAST:
        kept = [np.empty(out.size if masks else 0) for _ in range(3)]
        table = lobe_table()

        def work(start: int, stop: int) -> None:
            fill_fast(table, *flat, start, stop, out, *kept)
            if masks:
                _mask(masking_number, bounded, seen, surface, flat[3], flat[4], *kept, start, stop, out)
    else:

        def work(start: int, stop: int) -> None:
            _fill_lobe(form_number, masking_number, bounded, seen, surface, *flat, start, stop, out)

    in_chunks(work, out.size, _CHUNK_FAST if form_number == FAST else _CHUNK)
    return out.reshape(shape)


@inline_kernel
def _masked(value, masking, bounded, seen, surface, roughness, reach, c_i, c_r, sxy2):
    if bounded:
        value *= value_at(seen, surface, 0, 0, c_i, VISIBILITY_OCTAVES) * value_at(seen, surface, 0, 0, c_r, VISIBILITY_OCTAVES)
    elif masking == SMITH:
        slope = math.sqrt(roughness / reach)
        value *= smith_masking(c_i, slope) * smith_masking(c_r, slope)
    if masking == V_GROOVE:
        value *= v_groove_masking(c_i, c_r, sxy2)
    return value


@kernel
def _fill_lobe(form, masking, bounded, seen, surface, theta_i, theta_r, phi, roughness, reach, start, stop, out):
    steps = (int(theta_i.size > 1), int(theta_r.size > 1), int(phi.size > 1), int(roughness.size > 1), int(reach.size > 1))
    several = int(surface.size > 1)
    for n in range(start, stop):
        one, other, around = theta_i[n * steps[0]], theta_r[n * steps[1]], phi[n * steps[2]]
        rough, far = roughness[n * steps[3]], reach[n * steps[4]]
        c_i, c_r = math.cos(one), math.cos(other)
        in_plane = 2.0 * math.sin(0.5 * (one - other)) * math.cos(0.5 * (one + other))
        half_sine = math.sin(0.5 * around)
        sxy2 = in_plane * in_plane + 4.0 * math.sin(one) * math.sin(other) * half_sine * half_sine
        value = scattering_sum(form, rough, far, c_i, c_r, sxy2) * lobe_geometry(far, c_i, c_r, sxy2)
        out[n] = _masked(value, masking, bounded, seen, surface[n * several], rough, far, c_i, c_r, sxy2)


@kernel
def _mask(masking, bounded, seen, surface, roughness, reach, cosines_i, cosines_r, asides, start, stop, out):
    many, several, longer = int(roughness.size > 1), int(surface.size > 1), int(reach.size > 1)
    for n in range(start, stop):
        out[n] = _masked(
            out[n], masking, bounded, seen, surface[n * several], roughness[n * many], reach[n * longer],
            cosines_i[n], cosines_r[n], asides[n],
        )  # fmt: skip


def spike_reflectance(theta_i: npt.ArrayLike, *, sigma_um: npt.ArrayLike, wavelength_um: npt.ArrayLike) -> FloatArray:
    """Share of the radiance along the mirror direction that the spike hands on: e^-g at the specular angle (14), (34), in 0..1.

    Raises ArrayError for angles outside 0..pi/2, sigma_um < 0 or wavelength_um not above 0."""
    sigma, wave = _height(sigma_um), _length("wavelength_um", wavelength_um)
    root = 4.0 * np.pi * sigma / wave * np.cos(_polar("theta_i", theta_i))
    return np.asarray(np.exp(-(root**2)))


def directional_albedo(
    theta_i: npt.ArrayLike,
    *,
    sigma_um: npt.ArrayLike,
    correlation_um: npt.ArrayLike,
    wavelength_um: npt.ArrayLike,
    masking: str = "smith",
    bounded: bool = True,
) -> FloatArray:
    """Share of the light from theta_i that lobe and spike give out in all directions together, by quadrature to 1e-6.

    With `bounded` it is at most 1; without, the published model exceeds 1 past about 75 degrees. Errors and warnings as `lobe_brdf`."""
    number = _choice("masking", masking, MASKINGS)
    lengths = _lengths(sigma_um, correlation_um, wavelength_um)
    angles, roughness, reach = np.broadcast_arrays(_polar("theta_i", theta_i), *two_numbers(*lengths))
    cosines = np.cos(angles)
    spike = np.exp(-4.0 * roughness * cosines**2)
    lobe = np.zeros(angles.shape)
    for pair in {(float(a), float(b)) for a, b in zip(roughness.ravel(), reach.ravel())}:
        here = (roughness == pair[0]) & (reach == pair[1])
        lobe[here] = lobe_albedo(cosines[here], *pair, masking=number, bounded=bounded)
    return spike + lobe


class Scattering(NamedTuple):
    """n scattered directions: `directions` (n, 3) unit vectors with z the normal and x forward, zeros where the draw left the hemisphere;
    `weights` (n,), whose mean is the directional albedo; `order` (n,) int64, 0 = spike."""

    directions: FloatArray
    weights: FloatArray
    order: IntArray


def sample_scattering(
    theta_i: float,
    n: int,
    *,
    sigma_um: float,
    correlation_um: float,
    wavelength_um: float,
    seed: int,
    masking: str = "none",
    bounded: bool = False,
) -> Scattering:
    """n directions into which light from theta_i is scattered, drawn by scattering order (see sampling.py).

    The mean of weight * value(direction) estimates spike + lobe integrated against `value`. Same seed, same bytes.
    Errors and warnings as `lobe_brdf`."""
    number = _choice("masking", masking, MASKINGS)
    lengths = [require(k, v, (), finite=True) for k, v in zip(("sigma_um", "correlation_um", "wavelength_um"),
                                                              (sigma_um, correlation_um, wavelength_um))]  # fmt: skip
    roughness, reach = (float(v) for v in two_numbers(*_lengths(*lengths)))
    c_i = math.cos(float(_polar("theta_i", require("theta_i", theta_i, ()))))
    uniform = np.random.default_rng(seed).random((int(n), 3))
    out = Scattering(np.zeros((int(n), 3)), np.zeros(int(n)), np.zeros(int(n), dtype=np.int64))
    seen = visibility_table(roughness, reach, number, bounded).reshape(1, 1, -1)
    slope = rms_slope_of(roughness, reach)

    def work(start: int, stop: int) -> None:
        _fill_samples(number, bounded, seen, slope, roughness, reach, c_i, uniform, start, stop, *out)

    in_chunks(work, int(n), _CHUNK)
    return out


@kernel
def _fill_samples(masking, bounded, seen, slope, roughness, reach, c_i, uniform, start, stop, directions, weights, orders):
    g0 = 4.0 * roughness * c_i * c_i
    s_i = math.sqrt(max(0.0, 1.0 - c_i * c_i))
    for n in range(start, stop):
        order = scattering_order(g0, uniform[n, 0], 0)
        orders[n] = order
        x, y, c_r = scattered_direction(order, reach, c_i, uniform[n, 1], uniform[n, 2])
        if c_r <= 0.0:
            continue
        directions[n, 0], directions[n, 1], directions[n, 2] = -x, y, c_r
        if order == 0:
            weights[n] = 1.0
            continue
        sxy2 = (x + s_i) * (x + s_i) + y * y
        g, a = roughness * (c_i + c_r) * (c_i + c_r), reach * sxy2
        weight = lobe_geometry(math.pi, c_i, c_r, sxy2) * math.exp(log_lobe_series(g, a) - log_lobe_series(g0, a))
        if bounded:
            weight *= value_at(seen, 0, 0, 0, c_i, VISIBILITY_OCTAVES) * value_at(seen, 0, 0, 0, c_r, VISIBILITY_OCTAVES)
        elif masking == SMITH:
            weight *= smith_masking(c_i, slope) * smith_masking(c_r, slope)
        if masking == V_GROOVE:
            weight *= v_groove_masking(c_i, c_r, sxy2)
        weights[n] = weight


def _choice(name: str, word: str, words: dict[str, int]) -> int:
    if word not in words:
        raise ArrayError(f"{name} is {word!r}; it must be one of {', '.join(words)}", name=name, value=word)
    return words[word]


def _polar(name: str, values: npt.ArrayLike) -> FloatArray:
    angles = require(name, values)
    # NaN is neither
    if angles.size and not (angles.min() >= 0.0 and angles.max() <= 0.5 * np.pi):
        require(name, angles, finite=True)
        raise ArrayError(
            f"{name} spans {angles.min():.6g} to {angles.max():.6g}; polar angles are 0 to pi/2 radians from the normal",
            name=name,
        )
    return angles


def _azimuth(phi: npt.ArrayLike) -> FloatArray:
    azimuth = require("phi", phi)
    if azimuth.size and not (azimuth.min() > -_MANY_TURNS and azimuth.max() < _MANY_TURNS):
        azimuth = np.remainder(require("phi", azimuth, finite=True), 2.0 * np.pi)
    return azimuth


def _length(name: str, values: npt.ArrayLike) -> FloatArray:
    lengths = require(name, values, finite=True)
    if lengths.size and not lengths.min() > 0.0:
        raise ArrayError(f"{name} is {lengths.min():.6g}; it must be above 0 micrometres", name=name, value=float(lengths.min()))
    return lengths


def _height(sigma_um: npt.ArrayLike) -> FloatArray:
    heights = require("sigma_um", sigma_um, finite=True)
    if heights.size and not heights.min() >= 0.0:
        raise ArrayError(
            f"sigma_um is {heights.min():.6g}; a standard deviation of height is 0 or more micrometres", name="sigma_um"
        )
    return heights


def _lengths(
    sigma_um: npt.ArrayLike, correlation_um: npt.ArrayLike, wavelength_um: npt.ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    sigma, correlation, wave = (
        _height(sigma_um),
        _length("correlation_um", correlation_um),
        _length("wavelength_um", wavelength_um),
    )
    if correlation.size and wave.size and (np.asarray(correlation) < wave).any():
        warnings.warn(
            f"correlation_um {correlation.min():.4g} is below the wavelength {wave.max():.4g} um: the scattering theory needs curvature "
            "radii far above the wavelength; take the result as an extrapolation",
            KirchhoffWarning,
            stacklevel=3,
        )
    return sigma, correlation, wave


def _visibilities(roughness: FloatArray, reach: FloatArray, masking: int, bounded: bool) -> tuple[IntArray, FloatArray]:
    """Which visibility table serves each element (n,), and the tables (surfaces, 1, nodes)."""
    if not bounded or not roughness.size:
        return np.zeros(1, dtype=np.int64), np.ones((1, 1, 1))
    pairs, which = np.unique(np.stack([roughness, reach]), axis=1, return_inverse=True)
    tables = np.array([visibility_table(float(a), float(b), masking, True) for a, b in pairs.T])
    return which.reshape(-1), tables[:, None, :]
