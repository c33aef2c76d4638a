"""Every setting, with its unit in its name, its range and its default beside it.

Unknown keys are refused with the nearest known name. Lengths in millimetres, angles in degrees unless the name says otherwise.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator
from pydantic_core import PydanticCustomError

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Degrees = Annotated[float, Field(ge=-90, le=90, allow_inf_nan=False)]


class Section(BaseModel):
    """Base of all sections: immutable, no unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)


class Scanning(Section):
    """What is done to scans before they become a surface."""

    registration: Literal["auto", "off", "poses", "turntable", "all"] = Field(
        "auto",
        description="auto: poses are moved only where the scans contradict them; off: taken as given; poses: refined; turntable: the scans "
        "were taken in order around one axis; all: nothing is known of them",
    )
    misfits: Literal["refuse", "leave-out"] = Field(
        "refuse", description="scans that could not be placed: the whole job is refused, or they are left out and named"
    )
    filters: tuple[Literal["flying", "isolated", "oblique", "smooth"], ...] = Field(
        (), description="in this order; each says what it removed"
    )
    most_oblique_deg: Annotated[float, Field(gt=0, le=89)] = Field(80.0, description="oblique: from the normal")
    least_patch_cells: Annotated[int, Field(ge=1)] = Field(20, description="isolated: smaller patches go")
    smooth_cells: Annotated[int, Field(ge=2, le=8)] = Field(3, description="smooth: half width of the window")
    refine: bool = Field(
        False, description="heights refined, within their noise, by the shading of a scan's brightness (linear in light)"
    )
    quality: bool = Field(True, description="measure what the scans are worth, with the next view")
    profile: Literal["bust-75", "bust-150", "bust-300"] = Field(
        "bust-150", description="what they are judged for: a print of that height in mm"
    )


class Meshing(Section):
    """From scans to one surface."""

    method: Literal["auto", "grid", "fuse", "poisson", "pivot"] = Field(
        "auto", description="how scans become triangles; auto chooses and says why"
    )
    voxel_mm: Positive | None = Field(None, description="edge of a fusion cell; without it, from the scans' own sample spacing")
    voxel_in_spacings: Annotated[float, Field(ge=0.25, le=8)] = Field(
        1.0, description="that cell where voxel_mm is not given, in medians of the distance between neighbouring samples"
    )
    max_angle_deg: Annotated[float, Field(gt=0, lt=90)] = Field(
        80.0,
        description="a grid triangle whose normal leans further than this from the line of sight is a depth jump and is left out",
    )
    closing: Literal["open", "half", "closed"] | None = Field(
        None,
        description="what nobody measured: left open, closed up to largest_hole_mm, or closed; without it, as the method does",
    )
    largest_hole_mm: Positive | None = Field(None, description="half: extent of the largest hole that is closed")
    poisson_engine: Literal["open3d", "pymeshlab"] = "open3d"


class Solidify(Section):
    """From a surface to a part that can be built."""

    close: Literal["auto", "repair", "relief"] = Field(
        "auto",
        description="repair fills holes and mends defects; relief gives what was seen from one side a back; auto chooses and says why",
    )
    relief_depth_mm: Positive = Field(
        20.0, description="how far behind its deepest point a relief from one view gets its back plane"
    )
    relief_back: Literal["plane", "hollow"] = Field("plane", description="hollow opens the back of a relief to a wall of wall_mm")
    max_move_mm: Positive = Field(
        0.05, description="how far repair may move any point of the surface; what needs more is refused"
    )
    max_vanished_percent: Annotated[float, Field(ge=0, le=100)] = Field(
        1.0, description="share of the area that repair may take away"
    )
    longest_hole_mm: Positive | None = Field(
        None, description="longest rim of a hole that repair fills; without it, all are filled"
    )
    cut: tuple[Finite, Finite, Finite, Finite] | None = Field(
        None, description="nx, ny, nz, d: a plane cut with a cap; what lies on the side of the normal, n . x > d, is kept"
    )
    base: Literal["auto", "none", "socle"] = Field(
        "auto", description="auto cuts the bust flat where its lower end is ragged or invented; socle puts a plinth under that"
    )
    base_height_mm: float | None = Field(None, description="height of the base plane above the lowest point; overrides auto")
    nameplate: str = Field("", description="text on a plate at the front of the socle")
    height_mm: Positive | None = Field(None, description="scale the finished part to this height")
    simplify_mm: Positive | Literal["auto"] | None = Field(
        None,
        description="largest distance that fewer triangles may lie off; auto takes a quarter of the printer's pixel or layer",
    )
    wall_mm: Positive | None = Field(None, description="hollow the part to a wall of this thickness")
    drain_mm: Annotated[float, Field(ge=0, allow_inf_nan=False)] = Field(4.0, description="diameter of drains; 0 drills none")
    print_up: tuple[Finite, Finite, Finite] = Field(
        (0.0, 1.0, 0.0), description="away from the build plate: the tilt for which it must drain"
    )
    file_up: Literal["z", "scan"] = Field(
        "z",
        description="z: STL and 3MF stand on z = 0 as slicers take them, and are read here as they were; scan: the frame of the scans, y up",
    )
    printer: str | None = Field(None, description="a profile of configs/printers, or a profile file, that the part is judged for")

    @field_validator("print_up")
    @classmethod
    def _points_somewhere(cls, up: tuple[float, float, float]) -> tuple[float, float, float]:
        if not any(up):
            raise PydanticCustomError("no_direction", "a direction is not all noughts; write for example [0, 1, 0]")
        return up


class Picture(Section):
    """The camera's sensor and lens."""

    width: Annotated[int, Field(ge=8, le=16384)] = 512
    height: Annotated[int, Field(ge=8, le=16384)] = 512
    camera: Literal["pinhole", "orthographic", "cylindrical"] = Field(
        "pinhole",
        description="of render, maps and draw; pinhole; orthographic: parallel rays, one scale everywhere; cylindrical: a whole turn around the "
        "object's upright middle axis, unrolled",
    )
    pixel_mm: Positive | None = Field(
        None, description="width of an orthographic pixel, height of a cylindrical row; without it, such that the object fits"
    )
    field_of_view_deg: Annotated[float, Field(gt=0.5, lt=150)] = Field(25.0, description="horizontal")
    distortion: Annotated[tuple[float, ...], Field(max_length=8)] = Field(
        (), description="k1 k2 p1 p2 k3 k4 k5 k6, as OpenCV orders them"
    )
    aperture_mm: Annotated[float, Field(ge=0, allow_inf_nan=False)] = Field(
        0.0, description="diameter of the lens; 0 is a pinhole"
    )
    focus_mm: Positive | None = Field(None, description="depth in focus; without it, the middle of the object")
    focal_length_mm: Positive = 50.0
    rim_mm: Positive | None = Field(None, description="diameter of a rim that cuts oblique bundles")
    rim_distance_mm: Annotated[float, Field(ge=0, allow_inf_nan=False)] = Field(0.0, description="of the rim before the aperture")
    vignetting: bool = Field(False, description="image irradiance of equation (15): cos^4 and what the rim lets through")
    exposure: Positive | None = Field(
        None, description="radiance times it is the picture's level, 1 = white; without it, measured"
    )


class Sensor(Section):
    """What counts the light: noise, response, numbers. Without noise pictures are sRGB of 8 bits."""

    noise: bool = False
    full_well: Positive = Field(20_000.0, description="electrons of a white pixel")
    read_noise: Annotated[float, Field(ge=0, allow_inf_nan=False)] = Field(5.0, description="standard deviation, electrons")
    dark_electrons: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    bits: Annotated[int, Field(ge=1, le=16)] = 8
    response: Literal["linear", "srgb", "gamma"] = "srgb"
    gamma: Annotated[float, Field(gt=0.1, lt=10)] = 2.2


class Light(Section):
    """How light is followed."""

    materials: tuple[str, ...] = Field(
        ("plaster", "steel"),
        description="one turntable each; names of configs/materials or paths of material files, from where the command runs or beside this file",
    )
    model: Literal["direct", "plan", "full", "report"] = Field(
        "direct",
        description="direct: sources, shadows, mirrors, no interreflection of matt surfaces; plan: as much as the tolerance asks for; "
        "full: the reference; report: the approximations of the 1991 report",
    )
    samples: Annotated[int, Field(ge=1, le=1024)] = Field(
        2,
        description="of every pixel of a turntable, where the model is direct; a matt material has twice as many where its picture is uneven, and one elsewhere; "
        "a picture of its own has eight times as many",
    )
    tolerance_percent: Annotated[float, Field(gt=0, le=50)] = Field(
        2.0, description="of the frame's mean radiance, for plan and full"
    )


class Turntable(Section):
    """The orbit around the bust."""

    frames: Annotated[int, Field(ge=1, le=100_000)] = 36
    elevation_deg: Degrees = 8.0
    swing_deg: Degrees = Field(0.0, description="the camera rises and falls by this once per turn")
    start_deg: Annotated[float, Field(allow_inf_nan=False)] = Field(0.0, description="azimuth of the first frame")
    show: Literal["picture", "stripes", "distance", "id"] = Field(
        "picture", description="stripes: bands of light mirrored by the surface, which bend where its slope does"
    )
    lights: Literal["model", "room"] = Field(
        "model", description="model: the camera goes round model and lights; room: the model turns, camera and lights stand still"
    )
    frame_format: Literal["png", "exr"] = "png"
    margin: Annotated[float, Field(ge=0, lt=1)] = Field(0.06, description="share of the frame left free on every side")
    fps: Annotated[int, Field(ge=1, le=240)] = 12


class Maps(Section):
    """Distance maps."""

    azimuths_deg: tuple[float, ...] = Field(
        (0.0, 35.0), description="focal points on the orbit from which distance maps are made"
    )
    elevation_deg: Degrees = 20.0
    contour_step_mm: Positive | None = Field(
        None, description="depth between contour lines; without it, chosen to give about 25 lines"
    )


class Checking(Section):
    """What a verdict is measured against."""

    max_invented_percent: Annotated[float, Field(ge=0, le=100)] = Field(
        25.0, description="share of the surface above the base that may be invented before the scans are called unfit"
    )
    severities: dict[str, Literal["note", "warning", "error"]] = Field(
        default_factory=dict, description="overrides by finding code"
    )


class Settings(Section):
    """Everything that can be set."""

    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    threads: Annotated[int, Field(ge=0, le=1024)] = Field(0, description="0 means all cores; results do not depend on it")
    memory_mb: Annotated[float, Field(ge=256, allow_inf_nan=False)] | None = Field(
        None,
        description="most memory that a command, with all that it starts, may take; one that needs more ends and says so. Without it, what the machine has. Results do not depend on it",
    )
    scan: Scanning = Scanning()
    meshing: Meshing = Meshing()
    solid: Solidify = Solidify()
    picture: Picture = Picture()
    sensor: Sensor = Sensor()
    light: Light = Light()
    turntable: Turntable = Turntable()
    maps: Maps = Maps()
    checking: Checking = Checking()

    def determining(self) -> dict[str, Any]:
        """What results depend on, JSON-ready: all but how many threads and how much memory it takes to make them."""
        return self.model_dump(mode="json", exclude={"threads", "memory_mb"})
