"""The story: the only room that knows every stage and the configuration; each command is one function here."""

from rangecheck.pipeline.doctor import doctor
from rangecheck.pipeline.outcome import Outcome

__all__ = ["Outcome", "doctor"]
