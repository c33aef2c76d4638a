"""Rays against triangles: Embree, and a brute-force oracle with the same two methods."""

from rangecheck.raycast.brute import BruteCaster
from rangecheck.raycast.embree import EmbreeCaster, Hits

__all__ = ["BruteCaster", "EmbreeCaster", "Hits"]
