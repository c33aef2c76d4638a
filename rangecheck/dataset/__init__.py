"""Test data for vision: pictures over sampled parameters, each with its truth, and the index that says what is where."""

from rangecheck.dataset.check import check_picture
from rangecheck.dataset.index import ROW_SCHEMA, SCHEMA, masks_document, read_index, runs_of
from rangecheck.dataset.picture import Made, make_picture
from rangecheck.dataset.ranges import Ranges, Sample, read_ranges

__all__ = [
    "ROW_SCHEMA",
    "SCHEMA",
    "Made",
    "Ranges",
    "Sample",
    "check_picture",
    "make_picture",
    "masks_document",
    "read_index",
    "read_ranges",
    "runs_of",
]
