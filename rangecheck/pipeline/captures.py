"""decode: structured-light pictures to a range scan."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.errors import OutputError
from rangecheck.export.mapped import coloured_ids, contour_picture
from rangecheck.export.pictures import write_png
from rangecheck.files import whole_file
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.subject import decoded, hashes
from rangecheck.pipeline.views import refuse_existing
from rangecheck.progress import Reporter
from rangecheck.scan.decode import DecodedScan, Reason
from rangecheck.scan.decode.structured_light import MAX_RESIDUAL_PX, MIN_CONTRAST
from rangecheck.scan.readers.npz import write_npz

#: points of the scan that are compared with another program's, at least, where there are so many
COMPARED = 20_000

REASONS = {
    Reason.SHADOW: "in shadow",
    Reason.FAINT: "stripes too faint",
    Reason.AMBIGUOUS: "codes contradict",
    Reason.MISSING: "pictures missing",
    Reason.UNSEEN: "unseen by the other camera",
    Reason.CONTRADICTED: "seen in two places",
    Reason.EPIPOLAR: "rays do not meet",
}


def decode(
    folder: str,
    out: str,
    *,
    pictures: bool,
    force: bool,
    reporter: Reporter,
    against: str | None = None,
    unit: str | None = None,
    min_contrast: float = MIN_CONTRAST,
    max_residual_px: float = MAX_RESIDUAL_PX,
) -> Outcome:
    """The range scan of the pictures in `folder`, on the left camera's grid with its brightness; with `pictures`, in a folder beside it where
    and why pixels hold no distance, and the contours of what they hold. `against`: points of another program, in the same frame, that the
    scan is compared with."""
    target = Path(out)
    if target.suffix.lower() != ".npz":
        raise OutputError(out, "must end in .npz")
    refuse_existing(out, force)
    reference = _points(against, unit, reporter) if against else None
    found = decoded(folder, reporter, min_contrast=min_contrast, max_residual_px=max_residual_px)
    write_npz(target, found.scan, force=force)
    where = target.with_name(f"{target.stem}_pictures")
    if pictures:
        _draw(found, where)
    counts = found.counts()
    valid = int(found.scan.valid.sum())
    median, far = (float(q) for q in np.nanquantile(found.both_px[found.scan.valid], [0.5, 0.9]))
    lines = [
        f"{out}: {valid:,} distances, {found.measured:,} measured and {counts['interpolated']:,} interpolated, "
        f"from {found.cells:,} projector cells",
        f"reprojection error {median:.2f} px (median), {far:.2f} px (90 %)",
        *(f"lost: {what}" for what in found.lost),
        *(f"  {counts[reason.name.lower()]:,} pixels {said}" for reason, said in REASONS.items() if counts[reason.name.lower()]),
        *([f"why each pixel holds no distance is in {where}"] if pictures else []),
    ]
    compared = None
    if reference is not None:
        compared = _compared(found, reference, reporter)
        lines.append(
            f"{against}: {compared['points']:,} points; distances of the scan to the nearest of them: median {compared['median_mm']:.3f} mm, "
            f"90 % within {compared['p90_mm']:.3f} mm"
        )
    content = document(
        "decode", output=out, valid=valid, measured=found.measured, counts=counts, lost=found.lost, against=compared,
        reprojection_px={"median": median, "p90": far}, inputs=hashes([folder, *([against] if against else [])]), seconds=reporter.seconds,
    )  # fmt: skip
    return Outcome(content, lines)


def _points(path: str, unit: str | None, reporter: Reporter) -> FloatArray:
    """All points of a cloud or of scans, (n, 3)."""
    from rangecheck.scan.point_cloud import PointCloud
    from rangecheck.scan.readers import read_measured

    with reporter.stage("reading what it is compared with"):
        return np.concatenate(
            [one.points_mm if isinstance(one, PointCloud) else one.points_mm() for one in read_measured(path, unit)]
        )


def _compared(found: DecodedScan, reference: FloatArray, reporter: Reporter) -> dict[str, Any]:
    """How far the scan's points lie from the nearest of the reference's; every so manyth of a large scan."""
    from scipy.spatial import cKDTree

    points = found.scan.points_mm()
    points = points[:: max(1, len(points) // COMPARED)]
    with reporter.stage("comparing"):
        away, _ = cKDTree(reference).query(points)
    return {
        "points": len(reference),
        "compared": len(points),
        "median_mm": float(np.median(away)),
        "p90_mm": float(np.quantile(away, 0.9)),
    }


def _draw(found: DecodedScan, folder: Path) -> None:
    """Where and why pixels hold no distance, as a picture and as numbers, and the contours; in a folder of their own, for scans are read by
    the folder."""
    ids = np.where(found.reason == Reason.MEASURED, 0, found.reason).astype(np.int32)
    names = [REASONS[Reason(k)] for k in range(1, len(Reason))]
    write_png(folder / "reasons.png", coloured_ids(ids, names, "Why pixels hold no distance"))
    write_png(folder / "contours.png", contour_picture(found.scan.depth_mm.astype(np.float64)))
    with whole_file(folder / "reasons.npz") as part, part.open("wb") as stream:
        np.savez_compressed(
            stream, reason=found.reason, names=np.array([r.name.lower() for r in Reason]), interpolated=found.interpolated,
            residual_px=found.residual_px,
        )  # fmt: skip
