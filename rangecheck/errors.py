"""One tree of exceptions. Each member states the rule, the value and the next step, and keeps what it measured as attributes.

The library never prints and never exits; the command line maps this tree to exit statuses in one place.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


class RangecheckError(Exception):
    """Base of all errors that rangecheck raises on purpose. Keyword arguments become attributes: what was measured."""

    def __init__(self, message: str, **measured: Any) -> None:
        super().__init__(message)
        self.measured = measured
        for name, value in measured.items():
            setattr(self, name, value)

    def __str__(self) -> str:
        """One line that no name in a file can break or colour: what is not printable is written as Python would escape it."""
        return "".join(c if c.isprintable() else repr(c)[1:-1] for c in super().__str__())


class InputError(RangecheckError):
    """A file or folder cannot be read, or does not hold what it says. `path` names it."""

    def __init__(self, path: str | Path, message: str, **measured: Any) -> None:
        super().__init__(f"{path}: {message}", **measured)
        self.path = Path(path)


class UnitMissing(InputError):
    """A file gives lengths without saying their unit; it is asked for, never guessed."""

    def __init__(self, path: str | Path) -> None:
        super().__init__(path, "the file does not say its unit of length; say it with --unit mm, cm, m, um or in")


class OutputError(RangecheckError):
    """A result cannot be written. `path` names it; nothing half-written is left under that name."""

    def __init__(self, path: str | Path, message: str, **measured: Any) -> None:
        super().__init__(f"{path}: {message}", **measured)
        self.path = Path(path)


class ArrayError(RangecheckError, ValueError):
    """An argument has the wrong shape, type or values. `name` is the argument."""


class SettingError(RangecheckError, ValueError):
    """A setting is unknown or out of its range. `key` is its dotted path."""


class CameraError(RangecheckError, ValueError):
    """A camera's numbers do not describe a camera."""


class ScanError(RangecheckError):
    """The scans hold too little, or contradict each other, for what was asked of them."""


class PosesRefused(ScanError):
    """Scans could not be shown to belong together at any pose; what was inspected is not fit. `lines` says of each why."""


class SurfaceError(RangecheckError):
    """A surface does not have the property that a step needs."""


class NotSolid(SurfaceError):
    """A surface is not the boundary of a solid. `findings` says why, with places."""


class SceneError(RangecheckError, ValueError):
    """A scene contradicts itself: a source inside a surface, an unknown material, energy from nothing."""


class DependencyMissing(RangecheckError):
    """A package or system library is not installed; the message ends with the one line that mends it."""

    def __init__(self, package: str, purpose: str, remedy: str) -> None:
        super().__init__(f"{package} is needed for {purpose} and could not be loaded; mend it with: {remedy}")
        self.package, self.purpose, self.remedy = package, purpose, remedy


@contextmanager
def told_of(path: str | Path) -> Iterator[None]:
    """Within this block, errors are about the content of the file or folder `path`: those that do not name it do so from here on."""
    try:
        yield
    except RangecheckError as error:
        if Path(path).name not in str(error):
            error.args = (f"{path}: {error}",)
        raise
