"""The command line; installed as `rangecheck_cli`."""

from .main import main

__all__ = ["main"]
