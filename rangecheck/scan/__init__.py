"""Range scans: what a range finder measured, and nothing that it did not."""

from rangecheck.scan.range_scan import RangeScan

__all__ = ["RangeScan"]
