"""Where sources are known to be seen whole, or not at all, so that only some of the shadow rays need be cast; and no bias of it.

Most of a picture lies in no penumbra. A pixel whose shadow rays to a source have all ended alike, and its neighbours' too, is settled: of a
group of four samples one, drawn by chance, still casts its ray. Where the answer is the expected one nothing changes; where it is not, the
surprise counts for all four (a control variate: the expected value stays that of casting all rays), and the pixel is settled no longer.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.kernels import in_chunks, stage_kernel
from rangecheck.scene.sources import form_factor
from rangecheck.transport.chance import CHECK, key_of
from rangecheck.transport.light import aim_soft, spread_over_source
from rangecheck.transport.queues import DIFFUSE
from rangecheck.transport.reflection import diffuse_of

#: samples of which one is checked
GROUP = 4
#: shadow rays of a pixel, or of it and its eight neighbours, that must have ended alike
_ENOUGH, _ENOUGH_AROUND = 16, 24
#: sources for which it is kept at most; answers counted at most
_MOST_SOURCES, _MOST = 16, 255
_LIT, _DARK = 1, 2
_ROWS = 64


class Sight:
    """lit, dark (pixels, sources) uint8: shadow rays that reached the source, and that did not; settled: which is known."""

    def __init__(self, height: int, width: int, sources: int) -> None:
        self._shape = (height, width)
        self.lit, self.dark, self.settled = (np.zeros((height * width, sources), np.uint8) for _ in range(3))

    @staticmethod
    def serves(sources: int, shadow_rays: int) -> bool:
        """Whether it is worth keeping: soft shadows of one ray, of not too many sources."""
        return shadow_rays == 1 and 0 < sources <= _MOST_SOURCES

    def settle(self) -> None:
        """Take note of what was seen since."""
        height, width = self._shape
        in_chunks(lambda start, stop: _settle(self.lit, self.dark, height, width, start, stop, self.settled), height, _ROWS)


@stage_kernel
def _settle(lit, dark, height, width, first, last, settled):
    """Pixels of rows first .. last - 1 that know each source."""
    for row in range(first, last):
        for column in range(width):
            here = row * width + column
            for s in range(lit.shape[1]):
                seen, hidden, enough = np.int64(lit[here, s]), np.int64(dark[here, s]), _ENOUGH
                if 0 < seen + hidden < _ENOUGH:
                    enough = _ENOUGH_AROUND
                    seen = hidden = np.int64(0)
                    for r in range(max(row - 1, 0), min(row + 2, height)):
                        for c in range(max(column - 1, 0), min(column + 2, width)):
                            seen += lit[r * width + c, s]
                            hidden += dark[r * width + c, s]
                known = 0
                if seen + hidden >= enough and (seen == 0 or hidden == 0):
                    known = _LIT if hidden == 0 else _DARK
                settled[here, s] = known


@stage_kernel
def aim_unsettled(sources, materials, hits, start, stop, settled, pixels, shadows, sample, tally):
    """`aim` with one shadow ray to a place of each source, where that is not known beforehand: light that is known to arrive is added to
    sample and tally at once. pixels: those of the samples. Returns the number of shadow rays."""
    k = np.int64(0)
    for s in range(len(sources.radius)):
        r2 = sources.radius[s] * sources.radius[s]
        spread_over_source(hits, start, stop, s, 1, shadows)
        for i in range(start, stop):
            material = hits.material[i]
            x = sources.centre[s, 0] - hits.place[i, 0]
            y = sources.centre[s, 1] - hits.place[i, 1]
            z = sources.centre[s, 2] - hits.place[i, 2]
            d2 = x * x + y * y + z * z
            distance = math.sqrt(d2)
            nearness = 1.0 / distance
            x, y, z = x * nearness, y * nearness, z * nearness
            cosine = x * hits.shading[i, 0] + y * hits.shading[i, 1] + z * hits.shading[i, 2]
            sine2 = min(1.0, r2 / d2)
            factor = form_factor(cosine, sine2)
            if factor <= 0.0:
                continue
            known = settled[pixels[hits.pixel[i]], s]
            shines = materials.shiny[material]
            if known == 0 or shines or cosine * cosine <= sine2:
                k = aim_soft(
                    sources, materials, hits, i, s, x, y, z, distance, 1, math.pi * factor, shines, shadows, i - start, k
                )
                continue
            number = hits.number[i]
            group = number // np.uint32(GROUP)
            checked = (key_of(np.uint32(hits.stream[i] + group), CHECK + s) - number) % np.uint32(GROUP) == np.uint32(0)
            if known == _LIT:
                share = 1.0 - GROUP if checked else 1.0
                light = 0.0
                for c in range(sample.shape[1]):
                    gain = share * factor * hits.weight[i, c] * sources.radiance[s, c] * diffuse_of(materials, material, c)
                    sample[hits.pixel[i], c] += gain
                    light += gain
                tally[DIFFUSE, 1, s] += light
            if checked:
                before = k
                k = aim_soft(
                    sources, materials, hits, i, s, x, y, z, distance, 1, math.pi * factor, shines, shadows, i - start, k
                )
                for j in range(before, k):
                    for c in range(sample.shape[1]):
                        shadows.gain[j, c] *= GROUP
    return k


@stage_kernel
def remember(shadows, n, pixels, lit, dark):
    """Count what n shadow rays found, for the pixels of their samples."""
    for k in range(n):
        pixel, s = pixels[shadows.pixel[k]], shadows.source[k]
        if shadows.blocked[k]:
            dark[pixel, s] = min(np.int64(dark[pixel, s]) + 1, _MOST)
        else:
            lit[pixel, s] = min(np.int64(lit[pixel, s]) + 1, _MOST)
