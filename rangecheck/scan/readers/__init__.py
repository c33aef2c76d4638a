"""Files of range finders in, range scans out: one file per format, all lengths in millimetres from here on."""

from rangecheck.scan.readers.dispatch import read_measured, read_scans
from rangecheck.scan.readers.manifest import write_scans
from rangecheck.scan.readers.npz import write_npz
from rangecheck.scan.readers.pcd import write_pcd
from rangecheck.scan.readers.ptx import write_ptx

__all__ = ["read_measured", "read_scans", "write_npz", "write_pcd", "write_ptx", "write_scans"]
