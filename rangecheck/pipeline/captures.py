"""decode: structured-light pictures to a range scan."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rangecheck.errors import OutputError
from rangecheck.export.mapped import coloured_ids, contour_picture
from rangecheck.export.pictures import write_png
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.subject import decoded, hashes
from rangecheck.pipeline.views import refuse_existing
from rangecheck.progress import Reporter
from rangecheck.scan.decode import DecodedScan, Reason
from rangecheck.scan.readers.npz import write_npz

REASONS = {
    Reason.SHADOW: "in shadow",
    Reason.FAINT: "stripes too faint",
    Reason.AMBIGUOUS: "codes contradict",
    Reason.MISSING: "pictures missing",
    Reason.UNSEEN: "unseen by the other camera",
    Reason.CONTRADICTED: "seen in two places",
    Reason.EPIPOLAR: "rays do not meet",
}


def decode(folder: str, out: str, *, pictures: bool, force: bool, reporter: Reporter) -> Outcome:
    """The range scan of the pictures in `folder`, on the left camera's grid with its brightness; with `pictures`, beside it where
    and why pixels hold no distance, and the contours of what they hold."""
    target = Path(out)
    if target.suffix.lower() != ".npz":
        raise OutputError(out, "must end in .npz")
    refuse_existing(out, force)
    found = decoded(folder, reporter)
    write_npz(target, found.scan, force=force)
    if pictures:
        _draw(found, target)
    counts = found.counts()
    valid = int(found.scan.valid.sum())
    median, far = (float(q) for q in np.nanquantile(found.both_px[found.scan.valid], [0.5, 0.9]))
    lines = [
        f"{out}: {valid:,} distances, {found.measured:,} measured and {counts['interpolated']:,} interpolated, "
        f"from {found.cells:,} projector cells",
        f"reprojection error {median:.2f} px (median), {far:.2f} px (90 %)",
        *(f"lost: {what}" for what in found.lost),
        *(f"  {counts[reason.name.lower()]:,} pixels {said}" for reason, said in REASONS.items() if counts[reason.name.lower()]),
    ]
    content = document(
        "decode", output=out, valid=valid, measured=found.measured, counts=counts, lost=found.lost,
        reprojection_px={"median": median, "p90": far}, inputs=hashes([folder]), seconds=reporter.seconds,
    )  # fmt: skip
    return Outcome(content, lines)


def _draw(found: DecodedScan, target: Path) -> None:
    ids = np.where(found.reason == Reason.MEASURED, 0, found.reason).astype(np.int32)
    names = [REASONS[Reason(k)] for k in range(1, len(Reason))]
    write_png(target.with_suffix(".reasons.png"), coloured_ids(ids, names, "Why pixels hold no distance"))
    write_png(target.with_suffix(".contours.png"), contour_picture(found.scan.depth_mm.astype(np.float64)))
