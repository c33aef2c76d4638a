"""Registration: scans brought onto each other, and a verdict on every one of them."""

from rangecheck.scan.registration.evidence import Pair, Rules
from rangecheck.scan.registration.given import GivenPoses, check_poses
from rangecheck.scan.registration.register import register
from rangecheck.scan.registration.result import Registration, ScanState
from rangecheck.scan.registration.turntable import Turntable

__all__ = ["GivenPoses", "Pair", "Registration", "Rules", "ScanState", "Turntable", "check_poses", "register"]
