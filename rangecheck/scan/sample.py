"""The scans that the project ships: its own sculpted bust, as a range finder around it would have measured it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from rangecheck.errors import OutputError
from rangecheck.files import write_bytes
from rangecheck.optics import PinholeCamera
from rangecheck.raycast.implicit import ImplicitCaster
from rangecheck.rigid import look_at
from rangecheck.scan.readers.manifest import write_scans
from rangecheck.scan.simulate import RangeFinder, SimulatedScan, ring_of_poses, simulate_scan

SEED = 1991
VIEWS = 8
FINDER = RangeFinder(source_mm=(150.0, 0.0, 0.0), working_distance_mm=600.0, noise_mm=0.2, step_mm=0.02)
#: 0.69 mm per pixel at the working distance: the bust fills the picture's height
CAMERA = PinholeCamera(640, 480, 870.0, 870.0, 319.5, 239.5)
TARGET_MM = (0.0, 152.0, -4.0)

README = """# Sample scans

Range scans of a head-and-shoulders bust, 300 mm tall, that exists only as a function: `rangecheck.analytic.bust`. Its surface is the
function's zero set, so the true distance of every cell is known to rounding.

- `scans.json`, `view_0.png` to `view_7.png`: eight views, 45 degrees apart, in turn from 12 degrees below and 38 degrees above.
- `frontal/`: one view of the face, with the brightness picture that the same camera took.

The instrument (`rangecheck.scan.sample.FINDER`) is simulated: active triangulation at 600 mm with a baseline of 150 mm, noise of 0.2 mm
(standard deviation at 600 mm and normal incidence, growing with the square of the distance and with obliquity), shadow of its
light source, losses at grazing angles, depth in steps of 0.02 mm, seed 1991. Depth pictures are 16-bit PNG; a count of 0 means that
nothing returned; `scans.json` holds unit, step, camera and pose.

`rangecheck sample -o DIR` makes all files again, byte for byte (another release of zlib may pack the same counts differently). Licence: that of the project.
"""


def sample_view(index: int) -> SimulatedScan:
    """View `index` (0 to 7) of the ring, with its truth."""
    pose = ring_of_poses(VIEWS, FINDER.working_distance_mm, target_mm=TARGET_MM, elevations_deg=(-12.0, 38.0))[index]
    return simulate_scan(ImplicitCaster.of_bust(), CAMERA, pose, FINDER, SEED, scan_index=index, name=f"view_{index}")


def sample_frontal() -> SimulatedScan:
    """The single view of the face, with brightness (in 255 steps) and its truth."""
    azimuth, elevation = np.radians(8.0), np.radians(4.0)
    outward = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    pose = look_at(np.array(TARGET_MM) + FINDER.working_distance_mm * outward, TARGET_MM)
    made = simulate_scan(
        ImplicitCaster.of_bust(), CAMERA, pose, FINDER, SEED, scan_index=VIEWS, name="frontal", with_brightness=True
    )
    scan = made.scan
    assert scan.brightness is not None
    coarse = (np.rint(scan.brightness * 255.0) / 255.0).astype(np.float32)
    return replace(made, scan=replace(scan, brightness=coarse))


def make_sample_data(folder: str | Path) -> list[Path]:
    """Write the sample scans into `folder`; the same bytes each time. Returns the manifests. Raises OutputError."""
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise OutputError(folder, "is a file; name a folder")
    write_bytes(folder / "README.md", README.encode())
    frontal = write_scans(folder / "frontal", [sample_frontal().scan], step_mm=FINDER.step_mm)
    # last: with the manifest of the views the folder is finished
    views = write_scans(folder, [sample_view(index).scan for index in range(VIEWS)], step_mm=FINDER.step_mm)
    return [views, frontal]
