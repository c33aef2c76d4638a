"""Speed against accuracy, and stability: takes callables, knows no stage. Definitions of studies live in `rangecheck.studies`."""

from rangecheck.study.charts import EdgeChart, Line, LineChart, SpeedChart
from rangecheck.study.machine import describe_machine
from rangecheck.study.parts import Part, peak_memory_mb, study_of_parts
from rangecheck.study.result import Study, write_study
from rangecheck.study.speed import Candidate, Measurement, Timed, measure, pareto_front
from rangecheck.study.stability import Edge, find_edge

__all__ = [
    "Candidate",
    "Edge",
    "EdgeChart",
    "Line",
    "LineChart",
    "Measurement",
    "Part",
    "SpeedChart",
    "Study",
    "Timed",
    "describe_machine",
    "find_edge",
    "measure",
    "pareto_front",
    "peak_memory_mb",
    "study_of_parts",
    "write_study",
]
