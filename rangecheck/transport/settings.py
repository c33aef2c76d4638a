"""What a picture is computed with. `planner` chooses these; `FULL` is the reference, `REPORT` has the 1991 report's own approximations."""

from __future__ import annotations

from dataclasses import dataclass, field

from rangecheck.errors import SettingError

GLINTS = ("ray", "corners", "fraction")
GATHERS = ("order", "fan")
DIFFUSE_WAYS = ("paths", "second", "cache")


@dataclass(frozen=True)
class Settings:
    """How light is followed.

    passes          observations of every pixel
    each            rays per observation, spread evenly over the pixel
    centre          rays through the pixel's middle instead
    uneven          0: every pixel has `each` rays; above: only those whose middle departs from the line through its neighbours by more than this
                    share of the mean radiance of what is seen, while for all others the ray through the middle is enough
    shadow_rays     rays to each source per hit: 0 one to its middle, k > 0 over its solid angle
    spike, lobe, diffuse  whether surfaces mirror, gather over the lobe, gather over the hemisphere (light from sources
                    is always reflected by all three)
    lobe_rays, diffuse_rays  rays of each hit that the camera sees; later hits send one ray for all
    gather_diffuse  over the hemisphere: `paths` rays of each hit; `cache` what is kept on the surfaces, gathered once for the scene (where
                    nothing shines); `second` rays of the surface seen, and at what they meet the light that is kept there
    records         places at which the light that is kept is gathered, before the surface's form asks for more
    depth           reflections followed at most; 1 is light straight from the sources
    least           paths that carry no more than this share are not followed (0: all are)
    roulette_from   from this reflection on paths end by chance, without bias; 0: never
    glints          sources in the mirror of the surface seen: `ray` those that the mirror ray meets, `corners` the report's
                    four corner rays, `fraction` the exact share of the pixel's mirrored footprint
    gather          over the lobe of the surface seen: `order` rays drawn by scattering order, `fan` the report's rings (39)
                    made even and weighted by their solid angle, lobe_rays then being the number of rings
    fan_step_deg    angle between rings
    backdrop        the camera itself sees the surroundings; else it sees darkness there
    """

    passes: int = 1
    each: int = 1
    centre: bool = False
    uneven: float = 0.0
    shadow_rays: int = 1
    spike: bool = True
    lobe: bool = True
    diffuse: bool = True
    lobe_rays: int = 1
    diffuse_rays: int = 1
    depth: int = 16
    least: float = 0.0
    roulette_from: int = 3
    glints: str = "fraction"
    gather: str = "order"
    gather_diffuse: str = "paths"
    records: int = 6000
    fan_step_deg: float = 5.0
    backdrop: bool = True

    @property
    def by_chance(self) -> bool:
        """Whether light is gathered by drawing directions, so that one sample tells little of its pixel."""
        return self.lobe or (self.diffuse and self.gather_diffuse != "cache")

    def __post_init__(self) -> None:
        for name, low, high in (
            ("passes", 1, 1 << 20),
            ("each", 1, 1024),
            ("shadow_rays", 0, 1024),
            ("records", 16, 1 << 20),
            ("depth", 1, 64),
            ("roulette_from", 0, 64),
        ):
            if not low <= getattr(self, name) <= high:
                raise SettingError(f"{name} is {getattr(self, name)}; it must lie between {low} and {high}", key=name)
        for name in ("lobe_rays", "diffuse_rays"):
            if not 0 <= getattr(self, name) <= 4096:
                raise SettingError(f"{name} is {getattr(self, name)}; it must lie between 0 and 4096", key=name)
        for name, known in (("glints", GLINTS), ("gather", GATHERS), ("gather_diffuse", DIFFUSE_WAYS)):
            if getattr(self, name) not in known:
                raise SettingError(f"{name} is {getattr(self, name)!r}; there are {', '.join(known)}", key=name)
        if not 0 < self.fan_step_deg <= 30:
            raise SettingError(f"fan_step_deg is {self.fan_step_deg}; it must lie between 0 and 30 degrees", key="fan_step_deg")
        if not 0 <= self.uneven < 10:
            raise SettingError(f"uneven is {self.uneven}; it must be at least 0 and below 10", key="uneven")
        if not 0 <= self.least < 1:
            raise SettingError(f"least is {self.least}; it must be at least 0 and below 1", key="least")


DIRECT = Settings(passes=1, centre=True, shadow_rays=0, spike=False, lobe=False, diffuse=False, depth=1)
REPORT = Settings(centre=True, shadow_rays=0, diffuse=False, depth=2, glints="corners", gather="fan", lobe_rays=6)
#: everything that light does: the reference
FULL = Settings(shadow_rays=1, depth=64, each=4)


#: how much of the light each model follows, in words
FOLLOWED = {
    "direct": "light straight from the lamps, and what mirrors show of it (light.model direct)",
    "plan": "as much of the light as the tolerance asks for (light.model plan)",
    "full": "all of the light, between surfaces too (light.model full)",
    "report": "light as in the report of 1991 (light.model report)",
}


@dataclass(frozen=True)
class Plan:
    """What a picture will be computed with, and why.

    settings  the light that is followed
    error     what the noise of the picture may be, relative to its mean radiance; None: settings.passes says how many samples
    grey      computed at one wavelength, and given to all
    forms     of the lobe, material by material: fast, or the cheaper smooth or rough; empty: all fast
    reasons   one line per decision
    """

    model: str
    tolerance: float
    settings: Settings
    error: float | None
    grey: bool = False
    forms: tuple[str, ...] = ()
    reasons: tuple[str, ...] = field(default=(), repr=False)

    def explain(self) -> list[str]:
        """The decisions, one line each, for people."""
        promised = f", tolerance {100 * self.tolerance:g} % of the mean radiance" if self.tolerance else ""
        return [f"{FOLLOWED[self.model]}{promised}", *self.reasons]
