"""Pixels of one matt ball in several pictures, and the joint least squares of its lamps, its body and the albedo of each pixel.

Albedos are drawn from a normal law about 1, unevenness and closeness of lamps from laws about 0, whose spreads are found with the rest (empirical
Bayes): a clean ball's pixels share their albedo, and even parallel light stays so. Albedos are eliminated (Kaufman 1975); outliers count less.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.recover.matt_light import (
    BODY_NUMBERS,
    GLOSS,
    LAMP_NUMBERS,
    SLOPE,
    STRENGTH,
    TURN,
    WIDTH,
    Surface,
    shown,
    slopes,
    turned,
)
from rangecheck.recover.sight import Sight

#: pictures from which pixels have albedos, and lamps beams, of their own
PAINTED = 3
#: residual, parts of full scale, from which a pixel counts less
OUTLYING = 0.02
#: cosine to the lamp below which a pixel says nothing of it; where beams are fitted, the shadow's edge is a witness
LEAST_COSINE, _EDGE = 0.15, 0.0
#: spreads of albedo, unevenness and closeness at first, and the least
_SPREAD, _UNEVEN, _CLOSE, _LEAST_SPREAD = 0.1, 0.1, 0.05, 1e-3
#: unevenness that beams may share
_SHARED = 1e-4
_ROUNDS, _STEPS, _SETTLED, _LONGEST = 10, 6, 1e-5, 0.15
#: ln of the gloss's width, and how far from it it may be expected;  the most of both slopes
_WIDTH, _WIDTHS, _STEEPEST, _WIDEST = math.log(0.35), 0.5, 0.8, 0.7


class MattBall:
    """seen (k, n), known (k, n) whether below saturation;  looked_for: those of a picture's numbers that are not known;  starts (k, 3) where the lamps begin, numbers (k, 6) of `matt_light` for each picture, surface (3,);
    noise of a pixel, spread of albedos, spreads of unevenness and closeness, as found."""

    def __init__(
        self,
        sight: Sight,
        pictures: Sequence[FloatArray],
        saturation: float,
        starts: FloatArray,
        *,
        rough: bool,
        same_strength: bool,
        looked_for: slice = slice(0, LAMP_NUMBERS),
    ) -> None:
        values = np.array([np.asarray(p, np.float64).reshape(-1)[sight.pixel] for p in pictures])
        self.sight, self.rough, self.same, self.looked_for = sight, rough, same_strength, looked_for
        self.known: BoolArray = np.isfinite(values) & (values < saturation)
        self.seen = np.nan_to_num(values)
        several = len(values) >= PAINTED
        self.beams = several
        self.noise, self.spread = OUTLYING, _SPREAD if several else 0.0
        self.beam_spread = np.array([_UNEVEN, _UNEVEN, _CLOSE])
        gains = np.maximum(np.linalg.norm(starts, axis=1), 1e-9)
        self.starts = starts / gains[:, None]
        self.numbers = np.zeros((len(values), LAMP_NUMBERS))
        self.numbers[:, STRENGTH] = np.log(gains).mean() if same_strength else np.log(gains)
        self.surface = np.array([0.2 if rough else 0.0, 0.02 if rough and several else 0.0, _WIDTH])
        self.least = _EDGE if several else LEAST_COSINE

    def take_over(self, other: MattBall) -> None:
        """The state of a fit to other pixels of the same pictures."""
        self.numbers, self.surface = other.numbers.copy(), other.surface.copy()
        self.noise, self.spread = other.noise, other.spread

    def directions(self) -> FloatArray:
        """(k, 3) of the lamps."""
        return np.array([turned(d, p[TURN]) for d, p in zip(self.starts, self.numbers)])

    def body(self) -> Surface:
        """The ball's surface as found."""
        return Surface(float(self.surface[SLOPE]), float(self.surface[GLOSS]), math.exp(float(self.surface[WIDTH])))

    def shown(self) -> tuple[FloatArray, FloatArray]:
        """(k, n) matt part at albedo 1, and gloss, at the present state."""
        parts = [shown(self.sight.normals, self.sight.views, d, p, self.body()) for d, p in zip(self.starts, self.numbers)]
        return np.array([p[0] for p in parts]), np.array([p[1] for p in parts])

    def weights(self, matt: FloatArray, gloss: FloatArray) -> FloatArray:
        """(k, n) of each pixel by how far it lies off, 0 where it is not to be used."""
        used = (self.known & (self.directions() @ self.sight.normals.T > self.least)).astype(float)
        off = (self.paint(matt, gloss, used) * matt + gloss - self.seen) / OUTLYING
        return np.asarray(used / np.sqrt(1.0 + off * off))

    def paint(self, matt: FloatArray, gloss: FloatArray, weight: FloatArray) -> FloatArray:
        """(n,) albedo over the mean, the most likely by data and spread."""
        if self.spread == 0.0:
            return np.ones(matt.shape[1])
        prior = (self.noise / self.spread) ** 2
        return np.asarray(((weight * matt * (self.seen - gloss)).sum(0) + prior) / ((weight * matt**2).sum(0) + prior))

    def solve(self) -> None:
        """Least squares in rounds of weighing; leaves all as found."""
        for _ in range(_ROUNDS):
            weight = self.weights(*self.shown())
            moved = 0.0
            for _ in range(_STEPS):
                step, covariance = self._step(weight)
                moved = max(moved, step)
                if step < _SETTLED:
                    break
            if self.spread > 0.0:
                self._spreads(weight, covariance)
            if moved < 10.0 * _SETTLED:
                break

    def strengths_apart(self) -> FloatArray:
        """(k,) how much each picture alone would have its lamp's strength differ from what was found, all else held: 0.01 is 1 %."""
        matt, gloss = self.shown()
        weight = self.weights(matt, gloss)
        model = self.paint(matt, gloss, weight) * matt + gloss
        return np.asarray((weight * model * self.seen).sum(1) / (weight * model**2).sum(1) - 1.0)

    def _spreads(self, weight: FloatArray, covariance: FloatArray) -> None:
        matt, gloss = self.shown()
        paint, total = self.paint(matt, gloss, weight), (weight * matt**2).sum(0)
        left = paint * matt + gloss - self.seen
        self.noise = math.sqrt(max(float((weight * left**2).sum() / weight.sum()), 1e-12))
        unsure = self.noise**2 / (total + (self.noise / self.spread) ** 2)
        away = paint - np.median(paint)
        self.spread = max(math.sqrt(float((away**2 + unsure)[total > 0.0].mean())), _LEAST_SPREAD)
        if self.beams:
            at = self._places()[:, [3, 4, 5]]
            variance = np.diag(covariance)[at] * self.noise**2
            squared = (self.numbers[:, [3, 4, 5]] ** 2 + variance).mean(0)
            squared[:2] = squared[:2].mean()
            self.beam_spread = np.maximum(np.sqrt(squared), _LEAST_SPREAD)

    def _places(self) -> IntArray:
        """(k, 6) where each picture's numbers stand among all: one strength may serve every picture."""
        k = len(self.seen)
        at = np.arange(LAMP_NUMBERS * k).reshape(k, LAMP_NUMBERS)
        if self.same:
            at[:, STRENGTH] = STRENGTH
        return at

    def _step(self, weight: FloatArray) -> tuple[float, FloatArray]:
        """One step of Gauss and Newton: the longest change, and the inverse of the matrix."""
        k, n = self.seen.shape
        matt, gloss = self.shown()
        paint = self.paint(matt, gloss, weight)
        off = paint * matt + gloss - self.seen
        size = LAMP_NUMBERS * k + BODY_NUMBERS
        matrix, right, joint = np.zeros((size, size)), np.zeros(size), np.zeros((n, size))
        places = self._places()
        body = np.arange(LAMP_NUMBERS * k, size)
        for j in range(k):
            by_matt, by_gloss = slopes(self.sight.normals, self.sight.views, self.starts[j], self.numbers[j], self.body())
            by = paint[:, None] * by_matt + by_gloss
            at = np.concatenate([places[j], body])
            weighed = by * weight[j][:, None]
            matrix[np.ix_(at, at)] += by.T @ weighed
            right[at] += weighed.T @ off[j]
            joint[:, at] += weighed * matt[j][:, None]
        if self.spread > 0.0:
            total = (weight * matt**2).sum(0) + (self.noise / self.spread) ** 2
            matrix -= joint.T @ (joint / total[:, None])
        self._expect(matrix, right, places, body)
        free = self._free(places, body)
        held = matrix[np.ix_(free, free)]
        held[np.diag_indices_from(held)] += 1e-6 * np.diag(held).mean()
        inverse = np.zeros((size, size))
        inverse[np.ix_(free, free)] = np.linalg.inv(held)
        step = np.clip(-inverse @ right, -_LONGEST, _LONGEST)
        self.numbers = self.numbers + step[places]
        self.surface = self.surface + step[body]
        self.surface[SLOPE] = min(max(float(self.surface[SLOPE]), 0.0), _STEEPEST)
        self.surface[GLOSS] = max(float(self.surface[GLOSS]), 0.0)
        self.surface[WIDTH] = min(float(self.surface[WIDTH]), math.log(_WIDEST))
        return float(np.abs(step).max()), inverse

    def _expect(self, matrix: FloatArray, right: FloatArray, places: IntArray, body: IntArray) -> None:
        """Add what is expected of beams and gloss before the pictures are seen."""
        prior = (self.noise / self.beam_spread) ** 2
        for j, numbers in enumerate(self.numbers):
            at = places[j, [3, 4, 5]]
            matrix[at, at] += prior
            right[at] += prior * numbers[[3, 4, 5]]
        for axis in (3, 4):
            # what all pictures share is paint
            shared, at = self.numbers[:, axis].mean(), places[:, axis]
            matrix[np.ix_(at, at)] += (self.noise / _SHARED) ** 2
            right[at] += (self.noise / _SHARED) ** 2 * shared * len(at)
        wide = body[WIDTH]
        matrix[wide, wide] += (self.noise / _WIDTHS) ** 2
        right[wide] += (self.noise / _WIDTHS) ** 2 * (self.surface[WIDTH] - _WIDTH)

    def _free(self, places: IntArray, body: IntArray) -> IntArray:
        numbers = (places if self.beams else places[:, : STRENGTH + 1])[:, self.looked_for]
        surface = body if self.rough and self.beams else body[: 1 if self.rough else 0]
        return np.unique(np.concatenate([numbers.ravel(), surface]))
