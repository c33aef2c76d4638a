"""The engine of studies: methods timed in turns, fronts, edges cornered by bisection, charts and documents that say what they ran on."""

import json
import math
import sys

import pytest

from rangecheck.errors import OutputError, SceneError, SettingError
from rangecheck.study import (
    Candidate,
    EdgeChart,
    Line,
    LineChart,
    Measurement,
    Part,
    SpeedChart,
    Study,
    describe_machine,
    find_edge,
    measure,
    pareto_front,
    study_of_parts,
    write_study,
)
from rangecheck.study.drawing import draw
from rangecheck.study.memory import run_watched


class Clock:
    """A clock that only the candidates move."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def candidate(clock, log, method, seconds, result):
    def run():
        log.append(method)
        clock.now += seconds
        return result

    return Candidate(method, "", run)


def test_methods_are_timed_in_turns_forwards_and_backwards_after_a_warm_up():
    clock, log = Clock(), []
    candidates = [candidate(clock, log, "a", 2.0, 0.1), candidate(clock, log, "b", 3.0, -0.2)]
    measured = measure(candidates, abs, rounds=4, warmups=2, clock=clock)
    assert log == ["a", "a", "b", "b"] + ["a", "b", "b", "a"] * 2
    assert [(m.method, m.seconds, m.error, m.rounds) for m in measured] == [("a", 2.0, 0.1, 4), ("b", 3.0, 0.2, 4)]
    assert measured[0].quartiles == (2.0, 2.0)


def test_the_time_is_the_median_and_the_spread_its_quartiles():
    clock, times = Clock(), iter([9.0, 1.0, 2.0, 3.0, 4.0, 100.0])

    def run():
        clock.now += next(times)

    (only,) = measure([Candidate("a", "", run)], lambda _: 0.0, rounds=5, clock=clock)
    assert only.seconds == 3.0 and only.quartiles == (2.0, 4.0)


def test_what_cannot_be_measured_is_refused():
    same = [Candidate("a", "1", int), Candidate("a", "1", int)]
    with pytest.raises(SettingError, match=r"two candidates are called \('a', '1'\)"):
        measure(same, float)
    with pytest.raises(SettingError, match="0 candidates"):
        measure([], float)
    with pytest.raises(SettingError, match="0 rounds"):
        measure(same[:1], float, rounds=0)


def timed(method, seconds, error):
    return Measurement(method, "", error, seconds, (seconds, seconds), 1)


def test_the_front_holds_what_nothing_beats_in_both():
    all_of = [
        timed("slow best", 9, 0.01),
        timed("fast", 1, 0.5),
        timed("beaten", 5, 0.5),
        timed("middle", 3, 0.1),
        timed("mute", 0.1, math.nan),
    ]
    assert [m.method for m in pareto_front(all_of)] == ["fast", "middle", "slow best"]
    assert pareto_front([]) == []


@pytest.mark.parametrize("edge", [0.0123, 7.5, 950.0])
def test_an_edge_is_cornered_to_its_tolerance_from_either_side(edge):
    up = find_edge("square", lambda k: (k / edge) ** 2, 1e-3, 1e3, 1.0, logarithmic=True, tolerance=1e-6)
    assert up.holds_at <= edge <= up.breaks_at <= up.holds_at * (1 + 2e-6)
    down = find_edge("inverse", lambda k: edge / k, 1e3, 1e-3, 1.0, logarithmic=True, tolerance=1e-6)
    assert down.breaks_at <= edge <= down.holds_at <= down.breaks_at * (1 + 2e-6)
    even = find_edge("line", lambda k: k / edge, 0.0, 1e3, 1.0, tolerance=1e-7)
    assert even.holds_at <= edge <= even.breaks_at <= even.holds_at + 1e-4


def test_the_first_of_several_edges_is_the_one_that_is_found():
    edge = find_edge("waves", lambda k: math.sin(k), 0.0, 20.0, 0.5, samples=201, tolerance=1e-9)
    assert edge.breaks_at == pytest.approx(math.pi / 6, abs=1e-6)
    assert edge.in_words == "waves: holds 0.5 up to 0.523599, breaks it at 0.523599"


def test_nothing_to_find_and_nothing_that_holds_are_both_said():
    whole = find_edge("calm", lambda k: 0.0, 0.0, 1.0, 0.5)
    assert whole.breaks_at is None and whole.holds_at == 1.0 and "holds 0.5 from 0 to 1" in whole.in_words
    never = find_edge("wild", lambda k: 1.0, 0.0, 1.0, 0.5)
    assert never.holds_at is None and never.breaks_at == 0.0 and "from the start" in never.in_words


def test_no_number_and_an_error_raised_on_purpose_count_as_broken():
    def fails(k):
        if k > 2.0:
            raise SceneError("no")
        return math.nan if k > 1.0 else 0.0

    assert find_edge("fails", fails, 0.0, 4.0, 0.5, tolerance=1e-9).breaks_at == pytest.approx(1.0, abs=1e-6)
    with pytest.raises(ZeroDivisionError):
        find_edge("bug", lambda k: 1 / 0, 0.0, 1.0, 0.5)


@pytest.mark.parametrize(("start", "stop", "logarithmic"), [(0.0, 1.0, True), (1.0, 1.0, False), (0.0, math.inf, False)])
def test_an_empty_sweep_is_refused(start, stop, logarithmic):
    with pytest.raises(SettingError, match="needs two different ends"):
        find_edge("none", float, start, stop, 1.0, logarithmic=logarithmic)


def a_study():
    speed = SpeedChart(
        "speed",
        "Speed",
        "error",
        "ns each",
        [timed("a", 1e-3, 0.1), timed("b", 5e-3, 0.0), timed("c", 9e-3, math.nan)],
        1000,
        1e9,
    )
    edges = EdgeChart("edge", "Edge", "knob", "error", [find_edge("a", lambda k: k, 1e-3, 10, 1.0, logarithmic=True)])
    lines = LineChart("lines", "Lines", "x", "y", [Line("one", [1, 2], [1.0, math.nan], True)], level=1.0)
    return Study(
        "trial",
        "A trial",
        [speed, edges, lines],
        ["found"],
        {"rows": [{"x": math.inf}]},
        {**describe_machine(), "load_average_1min": 0.0},
    )


def test_a_study_is_written_as_pictures_and_one_document_that_json_allows(tmp_path):
    written = write_study(a_study(), tmp_path / "out")
    assert [p.name for p in written] == ["trial.json"] + [
        f"trial-{s}.{k}" for s in ("speed", "edge", "lines") for k in ("svg", "png")
    ]
    document = json.loads(written[0].read_text(), parse_constant=pytest.fail)
    assert document["schema"] == "rangecheck/study/1" and document["machine"]["cores"] >= 1
    speed, edge, lines = document["charts"]
    assert [(m["method"], m["time"], m["on_front"]) for m in speed["measurements"]] == [
        ("a", 1000.0, True),
        ("b", 5000.0, True),
        ("c", 9000.0, False),
    ]
    assert speed["measurements"][2]["error"] is None and document["tables"]["rows"] == [{"x": None}]
    assert edge["edges"][0]["breaks_at"] == pytest.approx(1.0, rel=2e-3) and "breaks it at" in edge["edges"][0]["in_words"]
    assert (
        lines["kind"] == "line"
        and written[1].read_bytes().startswith(b"<?xml")
        and written[2].read_bytes().startswith(b"\x89PNG")
    )
    with pytest.raises(OutputError, match="exists already"):
        write_study(a_study(), tmp_path / "out", force=False)


def test_a_short_logarithmic_axis_reads_in_plain_numbers():
    from matplotlib.figure import Figure

    from rangecheck.study.drawing import _scales

    for values, expected in (([4.0, 12.0], {"4", "5", "6", "8", "10"}), ([1e-9, 1.0], set())):
        axes = Figure().add_subplot()
        axes.plot(values, values)
        _scales(axes, "xy")
        axes.figure.canvas.draw()
        for axis in (axes.xaxis, axes.yaxis):
            shown = {label.get_text() for label in axis.get_ticklabels()}
            assert expected <= shown and any("10^" in text for text in shown) is not bool(expected)


def test_counts_have_ticks_at_whole_numbers_and_cases_their_names():
    from matplotlib.figure import Figure

    from rangecheck.study.drawing import _draw_lines

    def ticks(chart):
        axes = Figure().add_subplot()
        _draw_lines(axes, chart)
        axes.figure.canvas.draw()
        low, high = axes.get_xlim()
        labels = zip(axes.get_xticks(), axes.get_xticklabels())
        return [label.get_text() for place, label in labels if low <= place <= high], axes.lines

    counts, _ = ticks(LineChart("c", "C", "pictures", "y", [Line("one", [1, 2], [0.1, 0.05], True)], "xy", whole=True))
    assert counts == ["1", "2"]
    many, _ = ticks(LineChart("c", "C", "pictures", "y", [Line("one", list(range(40)), [1.0] * 40)], whole=True))
    assert many and all(float(text) == int(text) for text in many)
    cases, drawn = ticks(LineChart("c", "C", "case", "y", [Line("one", [0, 1], [0.1, 0.05])], names=["left", "right"]))
    # no line joins what has no order
    assert cases == ["left", "right"] and drawn[0].get_linestyle() == "None"


def test_the_same_numbers_give_the_same_bytes():
    study = a_study()
    assert draw(study.charts[0], study.machine) == draw(study.charts[0], study.machine)


def test_the_machine_says_processor_and_versions():
    machine = describe_machine()
    assert machine["processor"] and machine["packages"]["numpy"] and machine["python"]


def test_a_study_of_parts_runs_those_asked_for_and_says_what_they_took():
    asked = []

    def part(name):
        def run(quick):
            asked.append((name, quick))
            return Part(findings=[name], tables={name: [{"a": 1}]})

        return run

    study = study_of_parts("sums", "Sums", {name: part(name) for name in ("one", "two", "three")})
    whole = study(quick=True)
    assert asked == [("one", True), ("two", True), ("three", True)] and whole.findings == ["one", "two", "three"]
    some = study(part="three")
    assert some.name == "sums-three" and set(some.tables) == {"parts", "three"}
    assert all(row["seconds"] >= 0 and row["peak_memory_mb"] > 1 for row in some.tables["parts"])
    with pytest.raises(SettingError, match="no part 'four'; its parts are one, two, three"):
        study(part="four")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the memory of processes is read from /proc")
def test_the_memory_of_a_command_is_that_of_all_it_starts():
    child = "import time; held = bytearray(60_000_000); time.sleep(0.5)"
    parent = f"import subprocess, sys; sys.exit(subprocess.run([sys.executable, '-c', {child!r}]).returncode + 3)"
    status, peak = run_watched([sys.executable, "-c", parent])
    assert status == 3 and 60 < peak < 200
