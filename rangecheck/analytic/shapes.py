"""Closed forms of simple solids: where a ray first meets them, signed distance, outward normal, area, volume.

Each shape stands in its own frame: centre or apex at the origin, axis along y. Millimetres (any unit of length serves); points and
unit directions are (..., 3), broadcast against each other; distances are (...,) float64, inf where a ray misses, negative signed distance
inside. A ray that starts on the surface leaves it: roots nearer than `skin` times the shape's size do not count.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from rangecheck.analytic.quartic import smallest_root_beyond
from rangecheck.arrays import FloatArray, unit_vectors
from rangecheck.errors import ArrayError

#: relative start of a ray: a few hundred roundings
SKIN = 1e-12


@dataclass(frozen=True)
class Shape:
    """Base of the shapes; every number is a positive length."""

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not (math.isfinite(value) and value > 0):
                raise ArrayError(f"{type(self).__name__}'s {item.name} is {value}; it must be a positive length", name=item.name)

    def first_hit(self, origins: FloatArray, directions: FloatArray) -> FloatArray:
        """Length along each ray to where it first meets the surface, from outside or inside; inf where it does not."""
        raise NotImplementedError

    def signed_distance(self, points: FloatArray) -> FloatArray:
        """Exact distance to the surface, negative inside."""
        raise NotImplementedError

    def normal(self, points: FloatArray) -> FloatArray:
        """Outward unit normal at points on the surface."""
        raise NotImplementedError

    @property
    def area(self) -> float:
        """Area of the surface."""
        raise NotImplementedError

    @property
    def volume(self) -> float:
        """Volume enclosed."""
        raise NotImplementedError


@dataclass(frozen=True)
class Sphere(Shape):
    """Sphere about the origin."""

    radius: float

    def first_hit(self, origins: FloatArray, directions: FloatArray) -> FloatArray:
        b = (origins * directions).sum(axis=-1)
        # the discriminant from the perpendicular offset: no cancellation for far origins
        offset = origins - b[..., None] * directions
        h2 = self.radius**2 - (offset * offset).sum(axis=-1)
        h = np.sqrt(np.where(h2 >= 0, h2, np.nan))
        return _first(np.stack(np.broadcast_arrays(-b - h, -b + h)), SKIN * self.radius)

    def signed_distance(self, points: FloatArray) -> FloatArray:
        return np.linalg.norm(points, axis=-1) - self.radius

    def normal(self, points: FloatArray) -> FloatArray:
        return unit_vectors(np.asarray(points, dtype=float))

    @property
    def area(self) -> float:
        return 4.0 * math.pi * self.radius**2

    @property
    def volume(self) -> float:
        return 4.0 / 3.0 * math.pi * self.radius**3


@dataclass(frozen=True)
class Plane(Shape):
    """The plane y = 0, its outside above; `extent` is only the size against which rounding is judged."""

    extent: float = 1.0

    def first_hit(self, origins: FloatArray, directions: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore", invalid="ignore"):
            return _first((-origins[..., 1] / directions[..., 1])[None], SKIN * self.extent)

    def signed_distance(self, points: FloatArray) -> FloatArray:
        return np.asarray(points, dtype=float)[..., 1]

    def normal(self, points: FloatArray) -> FloatArray:
        return np.broadcast_to([0.0, 1.0, 0.0], np.shape(points)).copy()

    @property
    def area(self) -> float:
        return math.inf

    @property
    def volume(self) -> float:
        return math.inf


@dataclass(frozen=True)
class Box(Shape):
    """Box of full widths `x`, `y`, `z` about the origin."""

    x: float
    y: float
    z: float

    @property
    def _half(self) -> FloatArray:
        return np.array([self.x, self.y, self.z]) / 2

    def first_hit(self, origins: FloatArray, directions: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (-self._half - origins) / directions, (self._half - origins) / directions
        inside = np.abs(origins) <= self._half
        parallel = np.broadcast_to(directions == 0, a.shape)
        enter = np.where(parallel, np.where(inside, -np.inf, np.inf), np.minimum(a, b)).max(axis=-1)
        leave = np.where(parallel, np.where(inside, np.inf, -np.inf), np.maximum(a, b)).min(axis=-1)
        return _first(np.where(enter <= leave, np.stack([enter, leave]), np.nan), SKIN * float(self._half.max()))

    def signed_distance(self, points: FloatArray) -> FloatArray:
        q = np.abs(points) - self._half
        return np.linalg.norm(np.maximum(q, 0.0), axis=-1) + np.minimum(q.max(axis=-1), 0.0)

    def normal(self, points: FloatArray) -> FloatArray:
        q = np.abs(points) - self._half
        face = np.argmax(q, axis=-1)[..., None] == np.arange(3)
        return np.where(face, np.sign(points), 0.0)

    @property
    def area(self) -> float:
        return 2.0 * (self.x * self.y + self.y * self.z + self.z * self.x)

    @property
    def volume(self) -> float:
        return self.x * self.y * self.z


@dataclass(frozen=True)
class Cylinder(Shape):
    """Closed upright cylinder, from -height/2 to height/2."""

    radius: float
    height: float

    def first_hit(self, origins: FloatArray, directions: FloatArray) -> FloatArray:
        o, d = np.broadcast_arrays(origins, directions)
        a = d[..., 0] ** 2 + d[..., 2] ** 2
        b = o[..., 0] * d[..., 0] + o[..., 2] * d[..., 2]
        cross = o[..., 0] * d[..., 2] - o[..., 2] * d[..., 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            h = np.sqrt(a * self.radius**2 - cross**2)
            side = np.stack([(-b - h) / a, (-b + h) / a])
            side = np.where(np.abs(o[..., 1] + side * d[..., 1]) <= self.height / 2, side, np.nan)
            caps = np.stack([(end * self.height / 2 - o[..., 1]) / d[..., 1] for end in (-1.0, 1.0)])
            reach2 = (o[..., 0] + caps * d[..., 0]) ** 2 + (o[..., 2] + caps * d[..., 2]) ** 2
            caps = np.where(reach2 <= self.radius**2, caps, np.nan)
        return _first(np.concatenate([side, caps]), SKIN * max(self.radius, self.height))

    def _excess(self, points: FloatArray) -> FloatArray:
        p = np.asarray(points, dtype=float)
        return np.stack([np.hypot(p[..., 0], p[..., 2]) - self.radius, np.abs(p[..., 1]) - self.height / 2], axis=-1)

    def signed_distance(self, points: FloatArray) -> FloatArray:
        q = self._excess(points)
        return np.hypot(*np.moveaxis(np.maximum(q, 0.0), -1, 0)) + np.minimum(q.max(axis=-1), 0.0)

    def normal(self, points: FloatArray) -> FloatArray:
        p = np.asarray(points, dtype=float)
        q = self._excess(p)
        outward = unit_vectors(p * [1.0, 0.0, 1.0])
        upward = np.sign(p[..., 1])[..., None] * np.array([0.0, 1.0, 0.0])
        return np.where((q[..., 0] >= q[..., 1])[..., None], outward, upward)

    @property
    def area(self) -> float:
        return 2.0 * math.pi * self.radius * (self.radius + self.height)

    @property
    def volume(self) -> float:
        return math.pi * self.radius**2 * self.height


@dataclass(frozen=True)
class Cone(Shape):
    """Closed cone: apex at the origin, base of `radius` at y = -height."""

    radius: float
    height: float

    def first_hit(self, origins: FloatArray, directions: FloatArray) -> FloatArray:
        o, d = np.broadcast_arrays(origins, directions)
        k2 = (self.radius / self.height) ** 2
        a = d[..., 0] ** 2 + d[..., 2] ** 2 - k2 * d[..., 1] ** 2
        b = o[..., 0] * d[..., 0] + o[..., 2] * d[..., 2] - k2 * o[..., 1] * d[..., 1]
        c = o[..., 0] ** 2 + o[..., 2] ** 2 - k2 * o[..., 1] ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            # b^2 - ac, as squares of the cross products: stable for far origins
            cross = np.cross(o, d)
            h = np.sqrt(k2 * (cross[..., 0] ** 2 + cross[..., 2] ** 2) - cross[..., 1] ** 2)
            q = -(b + np.copysign(h, b))
            side = np.stack([q / a, c / q])
            y = o[..., 1] + side * d[..., 1]
            side = np.where((y <= 0) & (y >= -self.height), side, np.nan)
            cap = (-self.height - o[..., 1]) / d[..., 1]
            reach2 = (o[..., 0] + cap * d[..., 0]) ** 2 + (o[..., 2] + cap * d[..., 2]) ** 2
            cap = np.where(reach2 <= self.radius**2, cap, np.nan)
        return _first(np.concatenate([side, cap[None]]), SKIN * max(self.radius, self.height))

    def _parts(self, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Distance to the mantle, distance to the base, and whether the point is inside."""
        p = np.asarray(points, dtype=float)
        r, y = np.hypot(p[..., 0], p[..., 2]), p[..., 1]
        slant = math.hypot(self.radius, self.height)
        along = np.clip((r * self.radius - y * self.height) / slant**2, 0.0, 1.0)
        mantle = np.hypot(r - along * self.radius, y + along * self.height)
        base = np.hypot(np.maximum(r - self.radius, 0.0), y + self.height)
        inside = (y <= 0) & (y >= -self.height) & (r * self.height <= -y * self.radius)
        return mantle, base, inside

    def signed_distance(self, points: FloatArray) -> FloatArray:
        mantle, base, inside = self._parts(points)
        return np.where(inside, -1.0, 1.0) * np.minimum(mantle, base)

    def normal(self, points: FloatArray) -> FloatArray:
        p = np.asarray(points, dtype=float)
        mantle, base, _ = self._parts(p)
        outward = unit_vectors(p * [1.0, 0.0, 1.0]) * self.height + np.array([0.0, self.radius, 0.0])
        return np.where((mantle <= base)[..., None], unit_vectors(outward), np.array([0.0, -1.0, 0.0]))

    @property
    def area(self) -> float:
        return math.pi * self.radius * (self.radius + math.hypot(self.radius, self.height))

    @property
    def volume(self) -> float:
        return math.pi * self.radius**2 * self.height / 3.0


@dataclass(frozen=True)
class Torus(Shape):
    """Ring about the y axis: tube of radius `minor` whose centre runs on a circle of radius `major` > `minor`."""

    major: float
    minor: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.minor >= self.major:
            raise ArrayError(f"torus has minor {self.minor} and major {self.major}; it needs minor < major", name="minor")

    def first_hit(self, origins: FloatArray, directions: FloatArray) -> FloatArray:
        o, d = np.broadcast_arrays(np.asarray(origins, dtype=float) / self.major, directions)
        # count from the foot of the perpendicular from the centre, so that far origins lose no digits
        foot = -(o * d).sum(axis=-1)
        o = o + foot[..., None] * d
        k = (o * o).sum(axis=-1) - (self.minor / self.major) ** 2 - 1.0
        coefficients = np.stack(
            [
                np.ones_like(k),
                np.zeros_like(k),
                2.0 * k + 4.0 * d[..., 1] ** 2,
                8.0 * o[..., 1] * d[..., 1],
                k * k - 4.0 * (self.minor / self.major) ** 2 + 4.0 * o[..., 1] ** 2,
            ],
            axis=-1,
        )
        # at most the whole torus away from the foot
        least = np.maximum(-foot + SKIN, -3.0)
        return (smallest_root_beyond(coefficients, least) + foot) * self.major

    def signed_distance(self, points: FloatArray) -> FloatArray:
        p = np.asarray(points, dtype=float)
        return np.hypot(np.hypot(p[..., 0], p[..., 2]) - self.major, p[..., 1]) - self.minor

    def normal(self, points: FloatArray) -> FloatArray:
        p = np.asarray(points, dtype=float)
        return unit_vectors(p - self.major * unit_vectors(p * [1.0, 0.0, 1.0]))

    @property
    def area(self) -> float:
        return 4.0 * math.pi**2 * self.major * self.minor

    @property
    def volume(self) -> float:
        return 2.0 * math.pi**2 * self.major * self.minor**2


def _first(roots: FloatArray, least: float) -> FloatArray:
    """The smallest root beyond `least` along axis 0; NaN does not count."""
    with np.errstate(invalid="ignore"):
        return np.where(roots > least, roots, np.inf).min(axis=0)
