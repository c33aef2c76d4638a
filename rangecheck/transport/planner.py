"""The planner: what of a scene's light may be left out of a picture.

For a tolerance, relative to the frame's mean radiance, the planner finds what may be left out: every decision rests on a bound or on
a pilot, a measurement on a few hundred pixels of the very picture, and says so. The error of leaving something out is the root
mean square over the pilot's pixels of the difference that it makes, measured twice with independent chance: the mean of the product
of the two differences is free of their noise. Twice its standard error is added.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.reflectance.fast import FAST_ERROR
from rangecheck.reflectance.forms import form_error
from rangecheck.scene import Scene
from rangecheck.transport.camera_rays import PictureRays, pixel_order
from rangecheck.transport.even import with_lobe_forms
from rangecheck.transport.plan_kept import off_at_once, off_at_second, rays_of_paths, rays_to_keep, records_for, seen_places
from rangecheck.transport.settings import FULL, Plan, Settings
from rangecheck.transport.tracer import Tracer

#: share of the tolerance that one thing left out may cost, and that all together may
_EACH_SHARE, _ALL_SHARE = 0.2, 0.5
#: share that everything left out and interpolation of kept light may cost together: the noise that this saves is worth more
_CACHE_SHARE = 0.8
#: the estimate of the remaining noise is asked to stay this far below what is left
_NOISE_SHARE = 0.95
_PILOT_PIXELS, _PILOT_PASSES = 2048, 8
#: light is kept on surfaces where following it takes so many times more rays; of the error over all of them the picture is taken to have
#: this share at least
_WORTH_KEEPING, _UNSEEN = 2.0, 0.2
#: of a small picture the pilot sees one pixel in so many, but not fewer than these
_ONE_IN, _FEWEST_PIXELS = 4, 320
#: a form that may be off by more than this share of the peak is not tried
_FORM_WORTH_A_TRY = 0.1
#: depths that are tried. Deeper, so few paths are left that following them costs next to nothing, while a pilot meets too few to tell what
#: they carry: in crevices of bright surfaces that is far more than it finds
_DEPTHS = (1, 2, 3, 4)


class Planner:
    """One scene, one picture, one tolerance; collects reasons on the way."""

    def __init__(self, tracer: Tracer, picture: PictureRays, tolerance: float, seed: int) -> None:
        self.tracer, self.picture, self.tolerance, self.seed = tracer, picture, tolerance, seed
        order = pixel_order(picture.camera.width, picture.camera.height)
        # blocks of 4 x 4 pixels, one from each of many equal stretches of the picture: spread over it, yet coherent
        enough = min(_PILOT_PIXELS, max(len(order) // _ONE_IN, _FEWEST_PIXELS))
        if tracer.materials.shiny.any():  # highlights are small, and bright
            enough = _PILOT_PIXELS
        blocks, wanted = max(1, len(order) // 16), min(len(order) // 16, enough // 16)
        places = (np.arange(wanted) + np.random.default_rng(seed).random(wanted)) / max(wanted, 1) * blocks
        chosen = order[: blocks * 16].reshape(blocks, 16)[places.astype(int)] if wanted else order
        self.pixels: IntArray = np.ascontiguousarray(chosen.ravel())
        self.reasons: list[str] = []
        self.forms: tuple[str, ...] = ("fast",) * len(tracer.scene.materials)
        self.spent = 0.0
        self.settings = FULL
        self.seen: tuple[FloatArray, FloatArray] = self._look(self.settings)
        self.mean = max(float(np.mean([half.mean(dtype=np.float64) for half in self.seen])), 0.0)

    def plan(self) -> Plan:
        if not self.mean > 0:
            self.reasons.append("the pilot saw no light at all: one sample per pixel, light straight from the sources")
            settings = Settings(spike=False, lobe=False, diffuse=False, depth=1)
            return Plan("plan", self.tolerance, settings, self.tolerance, reasons=tuple(self.reasons))
        self._shadows()
        self._reflections()
        self._depth()
        self._irradiance()
        self._branches()
        self._lobe_forms()
        grey = self._grey()
        left = math.sqrt(self.tolerance**2 - self.spent**2)
        error = _NOISE_SHARE * left
        self.reasons.append(
            f"samples: one through each pixel's middle, more at edges, highlights, penumbrae and noise until the estimated error is {_percent(error)}"
        )
        return Plan("plan", self.tolerance, self.settings, error, grey, self.forms, tuple(self.reasons))

    def _look(self, settings: Settings) -> tuple[FloatArray, FloatArray]:
        """(n, c) radiance of the pilot's pixels, twice, with independent chance."""
        settings = replace(settings, passes=_PILOT_PASSES, each=1, centre=False)
        first, second = (
            with_lobe_forms(self.tracer, self.forms)
            .probe(self.picture, self.pixels, settings, self.seed + 0x5EED + k)
            .mean(axis=0, dtype=np.float64)
            for k in (0, 1)
        )
        return first, second

    def _cost(self, without: Settings) -> tuple[float, tuple[FloatArray, FloatArray]]:
        """Relative error of these settings against the present ones, and what they see."""
        seen = self._look(without)
        return self._relative(seen[0] - self.seen[0], seen[1] - self.seen[1]), seen

    def _relative(self, first: FloatArray, second: FloatArray) -> float:
        """Root mean square of a difference that was measured twice, with two standard errors, relative to the mean radiance."""
        product = (first * second).mean(axis=1)
        squared = float(product.mean()) + 2.0 * float(product.std()) / math.sqrt(len(product))
        # light so rare that the two never meet still shows in the mean
        mean = 0.5 * float(first.mean() + second.mean())
        return math.sqrt(max(squared, mean * mean)) / self.mean

    def _allowed(self) -> float:
        return min(_EACH_SHARE * self.tolerance, _ALL_SHARE * self.tolerance - self.spent)

    def _try(self, name: str, without: Settings, said: str) -> bool:
        """Take `without` if it costs little enough."""
        cost, seen = self._cost(without)
        allowed = self._allowed()
        if cost <= allowed:
            self.settings, self.seen = without, seen
            self.spent += cost
            self.reasons.append(
                f"{name}: {said}; the pilot finds a difference of {_percent(cost)}, {_percent(allowed)} was allowed"
            )
            return True
        self.reasons.append(
            f"{name}: kept; without, the pilot finds an error of {_percent(cost)}, {_percent(allowed)} was allowed"
        )
        return False

    def _shadows(self) -> None:
        if not self.tracer.scene.sources:
            self.settings = replace(self.settings, shadow_rays=0)
            self.reasons.append("shadows: the scene has no sources")
            return
        if self.tracer.materials.shiny.any():
            self.reasons.append(
                "soft shadows: kept; where surfaces shine, the whole of a source is mirrored, and as many rays aim at it"
            )
            return
        self._try("soft shadows", replace(self.settings, shadow_rays=0), "one shadow ray to each source's middle")

    def _reflections(self) -> None:
        strengths = np.array([m.strengths().max(axis=1) for m in self.tracer.scene.materials])
        diffuse, spike, lobe = (
            strengths[:, 0].max(),
            (strengths[:, 1] + strengths[:, 3]).max(),
            (strengths[:, 2] + strengths[:, 3]).max(),
        )
        rough = max(m.sigma_um / max(m.wavelengths_um) for m in self.tracer.scene.materials)
        for name, strength, key in (
            ("mirroring (spike)", spike, "spike"),
            ("gathering over the lobe", lobe, "lobe"),
            ("diffuse interreflection", diffuse, "diffuse"),
        ):
            without = {
                "spike": replace(self.settings, spike=False),
                "lobe": replace(self.settings, lobe=False),
                "diffuse": replace(self.settings, diffuse=False),
            }[key]
            if not strength > 0 or (key == "lobe" and rough == 0.0):
                self.settings = without
                self.reasons.append(f"{name}: no material has it")
            else:
                self._try(name, without, "left out")

    def _depth(self) -> None:
        if not (self.settings.spike or self.settings.lobe or self.settings.diffuse):
            self.settings = replace(self.settings, depth=1)
            self.reasons.append("depth: light straight from the sources is all there is")
            return
        narrow = 0.0
        for depth in _DEPTHS:
            cost, seen = self._cost(replace(self.settings, depth=depth))
            # the deeper the light, the rarer it is in a pilot, whose product then misses it; its mean does not, and it is at least as unevenly
            # spread as light of fewer reflections
            mean = 0.5 * abs(float((seen[0] - self.seen[0]).mean() + (seen[1] - self.seen[1]).mean())) / self.mean
            narrow = narrow if depth > _DEPTHS[0] else cost / mean if mean > 0 else 0.0
            cost = max(cost, narrow * mean)
            allowed = self._allowed()
            if cost <= allowed:
                self.settings, self.seen = replace(self.settings, depth=depth), seen
                self.spent += cost
                self.reasons.append(
                    f"depth: {depth} reflections; those beyond make a difference of {_percent(cost)}, {_percent(allowed)} was allowed"
                )
                return
        self.reasons.append(f"depth: {FULL.depth} reflections; {_DEPTHS[-1]} would leave an error of {_percent(cost)}")

    def _irradiance(self) -> None:
        """Diffuse interreflection looked up where it is kept on the surfaces, at the surface seen or one reflection on, if that is good enough
        and cheaper than following paths."""
        if not self.settings.diffuse or self.tracer.materials.shiny.any():
            return
        tracer, pixels = self.tracer, self.picture.camera.width * self.picture.camera.height
        records = records_for(pixels)
        samples = self._samples_to_come()
        keeping, following = rays_to_keep(tracer, records), rays_of_paths(tracer, pixels, samples)
        if following < _WORTH_KEEPING * keeping:
            self.reasons.append(
                f"diffuse light: followed path by path, about {samples:.0f} samples a pixel and {following:.2g} rays; to keep it on the "
                f"surfaces would take as long as {keeping:.2g}"
            )
            return
        kept = tracer.irradiance(self.settings.depth, records)
        seen, looked_at = seen_places(tracer, self.picture, self.pixels)
        if not len(seen.face):
            return
        allowed = _CACHE_SHARE * self.tolerance - self.spent
        tried = []
        for way, words, off in (
            ("cache", "at the surface seen", partial(off_at_once, kept, seen, looked_at)),
            ("second", "where rays of the surface seen arrive", partial(off_at_second, tracer, kept, seen, looked_at, self.seed)),
        ):
            # some hundred places may miss the few where interpolation fails, which the error over all surfaces tells of
            cost = max(self._relative(*off()), _UNSEEN * kept.error)
            tried.append(f"{words} {_percent(cost)} of the picture")
            if cost <= allowed and (way == "cache" or self.settings.depth > 1):
                self.settings = replace(self.settings, gather_diffuse=way, records=records)
                self.seen = self._look(self.settings)
                self.spent += cost
                self.reasons.append(
                    f"diffuse light: looked up {words}; {kept.explain()}; off by {', '.join(tried)}; {_percent(allowed)} was allowed"
                )
                return
        self.reasons.append(
            f"diffuse light: followed path by path; kept on the surfaces: {kept.explain()}; off by {', '.join(tried)}; "
            f"{_percent(allowed)} was allowed"
        )

    def _samples_to_come(self) -> float:
        """Samples a pixel that present settings would take, from how much the pilot's two looks differ."""
        one = 0.5 * _PILOT_PASSES * float(((self.seen[0] - self.seen[1]) ** 2).mean())
        return one / (_NOISE_SHARE * self.tolerance * self.mean) ** 2

    def _branches(self) -> None:
        """How many rays gather at the surface seen: as many as pay, by the variance inside a pixel with one and with four."""
        if not self.settings.by_chance:
            return

        def variance(rays: int) -> float:
            settings = replace(self.settings, passes=_PILOT_PASSES, each=1, lobe_rays=rays, diffuse_rays=rays)
            seen = self.tracer.probe(self.picture, self.pixels, settings, self.seed + 77)
            return float(seen.var(axis=0, dtype=np.float64).mean())

        one, four = variance(1), variance(4)
        gathered = max(0.0, (one - four) * 4 / 3)
        rest = max(one - gathered, 1e-3 * one)
        rays = int(np.clip(round(math.sqrt(gathered / rest)) if rest > 0 else 1, 1, 8))
        self.settings = replace(self.settings, lobe_rays=rays, diffuse_rays=rays)
        self.reasons.append(
            f"gathering rays: {rays} at the surface seen, one further on; {100 * gathered / max(one, 1e-300):.0f} % of a sample's variance comes from gathering"
        )

    def _lobe_forms(self) -> None:
        """Each material's lobe by the cheapest form: smooth or rough cost half of the table, where the pilot finds no difference that counts."""
        kind = "at the middle of each source" if self.settings.shadow_rays == 0 else "over each source's solid angle"
        for index, material in enumerate(self.tracer.scene.materials):
            name = f"lobe of {material.name}"
            if not material.strengths()[2:].any() or not material.sigma_um > 0.0:
                continue
            bounds = {form: form_error(form, material) for form in ("smooth", "rough")}
            form = min(bounds, key=lambda f: bounds[f])
            said = f"the {form} form is off by {_percent(bounds[form])} of the lobe's peak at most"
            if bounds[form] > _FORM_WORTH_A_TRY:
                self.reasons.append(f"{name}: the fast form, within {_percent(FAST_ERROR)} of the series, {kind}; {said}")
                continue
            before = self.forms
            self.forms = (*before[:index], form, *before[index + 1 :])
            cost, seen = self._cost(self.settings)
            allowed = self._allowed()
            if cost <= allowed:
                self.seen, self.spent = seen, self.spent + cost
                self.reasons.append(
                    f"{name}: the {form} form, {kind}; {said}, which the pilot finds to change the picture by {_percent(cost)}, "
                    f"{_percent(allowed)} was allowed"
                )
            else:
                self.forms = before
                self.reasons.append(
                    f"{name}: the fast form, within {_percent(FAST_ERROR)} of the series, {kind}; {said}, which the pilot finds to change the "
                    f"picture by {_percent(cost)}, {_percent(allowed)} was allowed"
                )

    def _grey(self) -> bool:
        channels = self.tracer.scene.channels
        if channels == 1:
            self.reasons.append("colour: the scene has one wavelength")
            return False
        if _is_grey(self.tracer.scene):
            self.reasons.append("colour: one wavelength; no material and no light tells wavelengths apart")
            return True
        # against the wavelength that a grey picture would be made of
        first, second = (half - half[:, channels // 2][:, None] for half in self.seen)
        cost, allowed = self._relative(first, second), self._allowed()
        if cost <= allowed:
            self.spent += cost
            self.reasons.append(f"colour: one wavelength; the others differ by {_percent(cost)}, {_percent(allowed)} was allowed")
            return True
        self.reasons.append(
            f"colour: {channels} wavelengths; one would be off by {_percent(cost)}, {_percent(allowed)} was allowed"
        )
        return False


def _is_grey(scene: Scene) -> bool:
    """Whether every wavelength must give the same picture: no lobes or spikes, whose form depends on it, and no colour."""
    values = [source.radiance for source in scene.sources] + [scene.surroundings.low, scene.surroundings.high]
    values += [box.radiance for box in scene.surroundings.boxes]
    values += [m.strengths()[0] for m in scene.materials]
    picture = scene.surroundings.picture
    even = all(np.ptp(value) == 0 for value in values) and (picture is None or float(np.ptp(picture, axis=2).max()) == 0)
    return even and not any(m.strengths()[1:].any() for m in scene.materials)


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"
