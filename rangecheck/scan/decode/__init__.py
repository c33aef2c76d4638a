"""Structured light: pictures of Gray-code and phase-shift patterns to range scans."""

from rangecheck.scan.decode.capture import Capture, read_capture
from rangecheck.scan.decode.pictures import Pictures
from rangecheck.scan.decode.structured_light import DecodedScan, Reason, View, decode_gray_code

__all__ = ["Capture", "DecodedScan", "Pictures", "Reason", "View", "decode_gray_code", "read_capture"]
