"""The schema of every setting, and loading it. Read only by the pipeline and the command line."""

from rangecheck.config.load import load_settings
from rangecheck.config.schema import Settings

__all__ = ["Settings", "load_settings"]
