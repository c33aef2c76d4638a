"""Files of range finders in, range scans out: one file per format, all lengths in millimetres from here on."""

from rangecheck.scan.readers.dispatch import read_scans
from rangecheck.scan.readers.manifest import write_scans

__all__ = ["read_scans", "write_scans"]
