"""Directional albedo of lobe and spike by quadrature, and the bound that keeps it at or below 1 without losing reciprocity.

The published lobe gives out more than it receives past about 75 degrees, and masking alone does not mend it, because the spike tends
to 1 at grazing incidence while the lobe does not vanish. The bound is a scale s(theta) <= 1 of each direction,

    f_bounded = s(theta_i) s(theta_r) f,        s(theta_i) * integral of s(theta_r) f cos(theta_r)  <=  1 - e^-g(theta_i)

as large as the inequality allows, found by damped symmetric balancing (Sinkhorn & Knopp 1967, with inequalities). Being symmetric it
keeps reciprocity. A tracer reads the *visibility*, the product of s and Smith's masking, piecewise linear in the cosine; the bound is
solved for that very function, not for one that it approximates. At cos theta = 2^-VISIBILITY_OCTAVES (89.997 degrees) it is 0.
"""

from __future__ import annotations

import math
from functools import cache, lru_cache

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.kernels import in_chunks, kernel
from rangecheck.reflectance.fast import lobe_fast, lobe_table
from rangecheck.reflectance.fresnel import FRESNEL_OCTAVES
from rangecheck.reflectance.lobe import (
    FAST,
    SERIES,
    SMITH,
    UNMASKED,
    V_GROOVE,
    lobe_geometry,
    scattering_sum,
    smith_masking,
    v_groove_masking,
)
from rangecheck.reflectance.octaves import cell_and_share, node_count, nodes, value_at

#: octaves of cos theta in the visibility table
VISIBILITY_OCTAVES = 14
#: share of the allowance 1 - e^-g that is left unused, so that neither the error of `lobe_fast` nor that of the quadrature can carry
#: the sum above 1; the second where masking or the bound bends sharply (V-grooves, rms slopes above 1)
ENERGY_MARGIN, ENERGY_MARGIN_KINKED = 5e-5, 4e-4

_CHECKS_PER_CELL = 8
_GAUSS_X, _GAUSS_W = (np.ascontiguousarray(v) for v in np.polynomial.legendre.leggauss(6))
#: first panel in lobe widths, and growth of the panels in theta_r; halving both moves no albedo by more than 1e-6
_FINEST, _GROWTH_POLAR = 0.7, 0.5
_MAX_EDGES = 200
_MOST_ROUNDS = 400


@kernel
def _polar_edges(theta_i, width, kinks, edges):
    """Panels in theta_r: fine by `width` around the mirror direction and geometric towards both ends. Returns how many.

    `kinks` asks for narrower ones, where masking or the bound bends sharply between panels' edges."""
    finest, growth, widest = (0.5 * _FINEST, 0.5 * _GROWTH_POLAR, 0.05) if kinks else (_FINEST, _GROWTH_POLAR, 2.0)
    half_pi = 0.5 * math.pi
    count = 0
    step = finest * width
    at = 0.0
    while count < _MAX_EDGES - 40 and (theta_i - at > 0.0 or theta_i + at < half_pi):
        for sign in (-1.0, 1.0):
            edge = theta_i + sign * at
            if 0.0 < edge < half_pi:
                edges[count] = edge
                count += 1
        at += step
        step = min(widest, max(step, growth * at))
    for k in range(26):
        edges[count] = half_pi - 0.5**k if k > 0 else half_pi
        count += 1
    edges[count] = 0.0
    count += 1
    edges[:count].sort()
    return count


@kernel
def gather_lobe(form, table, roughness, reach, masking, rms_slope, facets, c_i, hats):
    """hats[j] += integral over the hemisphere of f cos(theta_r) times the j-th tent of the visibility table; K = 1, unbounded.

    The tents add up to 1, so that the sum of `hats` is the lobe's albedo. `masking` here is applied exactly, pair by pair; `facets`
    is a table of Fresnel's share (1, 1, nodes), or has a single node where nothing is absorbed."""
    theta_i = math.acos(c_i)
    s_i = math.sin(theta_i)
    reach_of_order = math.sqrt(max(1.0, 4.0 * roughness * c_i * c_i) / reach)
    edges = np.empty(_MAX_EDGES)
    kinks = masking == V_GROOVE or rms_slope > 1.0
    count = _polar_edges(theta_i, reach_of_order / (c_i + math.sqrt(reach_of_order)), kinks, edges)
    own_masking = smith_masking(c_i, rms_slope) if masking == SMITH else 1.0
    for e in range(count - 1):
        half = 0.5 * (edges[e + 1] - edges[e])
        if half <= 0.0:
            continue
        for p in range(_GAUSS_X.size):
            theta_r = edges[e] + half * (1.0 + _GAUSS_X[p])
            c_r, s_r = math.cos(theta_r), math.sin(theta_r)
            in_plane = 2.0 * math.sin(0.5 * (theta_i - theta_r)) * math.cos(0.5 * (theta_i + theta_r))
            base = in_plane * in_plane
            g = roughness * (c_i + c_r) * (c_i + c_r)
            arc = math.sqrt(max(1.0, g) / (reach * max(s_i * s_r, 1e-12)))
            around, largest, start = 0.0, 0.0, 0.0
            stop = min(_FINEST * arc, math.pi)
            while start < math.pi:
                half_arc = 0.5 * (stop - start)
                panel = 0.0
                for q in range(_GAUSS_X.size):
                    half_sine = math.sin(0.5 * (start + half_arc * (1.0 + _GAUSS_X[q])))
                    sxy2 = base + 4.0 * s_i * s_r * half_sine * half_sine
                    if form == FAST:
                        value = lobe_fast(table, g, reach * sxy2)
                    else:
                        value = scattering_sum(form, roughness, reach, c_i, c_r, sxy2)
                    value *= lobe_geometry(reach, c_i, c_r, sxy2)
                    if masking == V_GROOVE:
                        value *= v_groove_masking(c_i, c_r, sxy2)
                    if facets.size > 1:
                        h2 = (c_i + c_r) * (c_i + c_r) + sxy2
                        value *= value_at(facets, 0, 0, 0, 0.25 * h2, FRESNEL_OCTAVES)
                    panel += _GAUSS_W[q] * value
                around += panel * half_arc
                largest = max(largest, panel)
                if panel * (math.pi - stop) < 1e-14 * around:
                    break
                start = stop
                stop = min(math.pi, stop + max(_FINEST * arc, stop))
            share = 2.0 * around * c_r * s_r * half * _GAUSS_W[p]
            if masking == SMITH:
                share *= own_masking * smith_masking(c_r, rms_slope)
            cell, part = cell_and_share(c_r, VISIBILITY_OCTAVES)
            hats[cell] += share * (1.0 - part)
            hats[cell + 1] += share * part


@kernel
def _gather_many(form, table, roughness, reach, masking, rms_slope, facets, cosines, start, stop, out):
    for i in range(start, stop):
        gather_lobe(form, table, roughness, reach, masking, rms_slope, facets, cosines[i], out[i])


def lobe_shares(
    form: int, roughness: float, reach: float, masking: int, cosines: FloatArray, fresnel: FloatArray | None = None
) -> FloatArray:
    """(n, nodes) the lobe's albedo at each of `cosines`, divided among the tents of the visibility table; numbers as in lobe.py.

    `fresnel` is a table of `fresnel.fresnel_table`, if facets absorb."""
    out = np.zeros((len(cosines), node_count(VISIBILITY_OCTAVES)))
    table = lobe_table()
    facets = np.ones((1, 1, 1)) if fresnel is None else np.ascontiguousarray(fresnel).reshape(1, 1, -1)
    rms_slope = rms_slope_of(roughness, reach)

    def work(start: int, stop: int) -> None:
        _gather_many(form, table, roughness, reach, masking, rms_slope, facets, cosines, start, stop, out)

    in_chunks(work, len(cosines), 16)
    return out


def lobe_albedo(
    cosines: FloatArray,
    roughness: float,
    reach: float,
    *,
    masking: int,
    bounded: bool,
    form: int = SERIES,
    fresnel: FloatArray | None = None,
) -> FloatArray:
    """(n,) share of the light from directions of `cosines` (n,) that the lobe alone gives out; numbers as in lobe.py."""
    if roughness == 0.0:
        return np.zeros(len(cosines))
    within = UNMASKED if bounded and masking == SMITH else masking
    shares = lobe_shares(form, roughness, reach, within, np.ascontiguousarray(cosines), fresnel)
    if not bounded:
        return np.asarray(shares.sum(axis=1))
    table = visibility_table(roughness, reach, masking, True)
    return np.asarray(shares @ table * visibility_of(table, cosines))


def visibility_of(table: FloatArray, cosines: FloatArray) -> FloatArray:
    """The visibility at `cosines` from its table, as a tracer reads it."""
    return np.interp(cosines, nodes(VISIBILITY_OCTAVES), table)


@lru_cache(maxsize=256)
def visibility_table(roughness: float, reach: float, masking: int, bounded: bool) -> FloatArray:
    """s(theta) at `octaves.nodes(VISIBILITY_OCTAVES)` of the cosine, times Smith's masking where `masking` is SMITH; read-only.

    V-groove masking depends on the pair of directions, so it is not in the table, but the bound is solved with it."""
    cosines = np.minimum(nodes(VISIBILITY_OCTAVES), 1.0)
    rms_slope = rms_slope_of(roughness, reach)
    table = np.array([smith_masking(c, rms_slope) for c in cosines]) if masking == SMITH else np.ones(cosines.size)
    if bounded and roughness > 0.0:
        table = _bounded(table, roughness, reach, UNMASKED if masking == SMITH else masking, rms_slope)
    table.flags.writeable = False
    return table


def rms_slope_of(roughness: float, reach: float) -> float:
    """alpha = 2 sigma/T from the two numbers of the surface; 0 for a surface without correlation length."""
    return math.sqrt(roughness / reach) if reach > 0.0 else 0.0


@cache
def _check_points() -> tuple[FloatArray, FloatArray]:
    """Cosines (checks,) at which the bound is held, _CHECKS_PER_CELL to a cell, and the matrix (checks, nodes - 1) that carries what is
    smooth in the cosine from the nodes to them, by cubics through the four nodes around each."""
    at = nodes(VISIBILITY_OCTAVES)[:-1]
    check = np.arange((at.size - 1) * _CHECKS_PER_CELL + 1)
    cosines = np.interp(check / _CHECKS_PER_CELL, np.arange(at.size), at)
    first = np.clip(check // _CHECKS_PER_CELL - 1, 0, at.size - 4)
    carry = np.zeros((check.size, at.size))
    for j in range(4):
        weight = np.ones(check.size)
        for other in range(4):
            if other != j:
                weight *= (cosines - at[first + other]) / (at[first + j] - at[first + other])
        carry[np.arange(check.size), first + j] = weight
    return cosines, carry


def _bounded(table: FloatArray, roughness: float, reach: float, pair_masking: int, rms_slope: float) -> FloatArray:
    """The largest visibility not above `table` that keeps lobe + spike within 1 at every check point."""
    cosines, carry = _check_points()
    at = nodes(VISIBILITY_OCTAVES)[:-1]
    # the lobe's albedo has a factor 1/cos of its own direction; without it, it is smooth enough to be carried
    shares = carry @ (at[:, None] * lobe_shares(FAST, roughness, reach, pair_masking, at))
    margin = ENERGY_MARGIN_KINKED if pair_masking == V_GROOVE or rms_slope > 1.0 else ENERGY_MARGIN
    allowed = -np.expm1(-4.0 * roughness * cosines**2) * (1.0 - margin) * cosines
    # a node answers for the check points of the two cells beside it
    check = np.arange(cosines.size)
    below, above = check // _CHECKS_PER_CELL, -(-check // _CHECKS_PER_CELL)
    limit = table.copy()
    limit[0] = 0.0
    bounded = limit.copy()

    def excess() -> FloatArray:
        ratio = visibility_of(bounded, cosines) * (shares @ bounded) / allowed
        at_node = np.zeros(bounded.size)
        np.maximum.at(at_node, below, ratio)
        np.maximum.at(at_node, above, ratio)
        at_node[-1] = at_node[-2]
        return at_node

    for _ in range(_MOST_ROUNDS):
        grown = np.minimum(limit, bounded / np.sqrt(np.maximum(excess(), 1e-30)))
        settled = np.abs(grown - bounded).max() < 1e-9
        bounded = grown
        if settled:
            break
    # from here on only downwards: less of any direction lowers the albedo of every other
    for _ in range(_MOST_ROUNDS):
        now = excess()
        if now.max() <= 1.0:
            break
        bounded = bounded / np.maximum(now, 1.0)
    return bounded
