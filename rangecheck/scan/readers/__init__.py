"""Files of range finders in, range scans out: one file per format, all lengths in millimetres from here on."""

from rangecheck.scan.readers.dispatch import read_scans
from rangecheck.scan.readers.manifest import write_scans
from rangecheck.scan.readers.npz import write_npz

__all__ = ["read_scans", "write_npz", "write_scans"]
