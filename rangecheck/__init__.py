"""rangecheck: range scans of a head or sculpture in; a checked, physically rendered bust and its STL out."""

__version__ = "0.1.0"
