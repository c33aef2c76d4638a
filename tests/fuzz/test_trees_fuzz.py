"""Settings, scenes, materials and manifests whose trees were spoilt: wrong values in right places, lost, foreign and doubled parts.

Bytes struck at random seldom leave a document that its parser lets through; here it always is one, and what is asked is our own reading of
it. hypothesis draws the accidents and shrinks what is answered wrongly. Some examples of each kind run with the other tests; more by
RANGECHECK_FUZZ_TREES=2000 pytest tests/fuzz/test_trees_fuzz.py, others by RANGECHECK_FUZZ_SEED.
"""

from __future__ import annotations

import copy
import json
import math
import os
import tomllib
import warnings
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st

from fuzz.entries import GROUPS, Entry
from rangecheck.errors import RangecheckError

EXAMPLES = int(os.environ.get("RANGECHECK_FUZZ_TREES", "30"))
SEED = int(os.environ.get("RANGECHECK_FUZZ_SEED", "1"))
#: entries of text that are trees, by group
TREES = {
    "settings": ("settings.toml", "material.toml", "printer.toml", "ranges.toml"),
    "scenes": ("scene.toml",),
    "documents": ("a.camera.json", "capture.json", "study.json", "unfinished.json", "frames.json", "scans.json"),
}
#: what readers stumble over: lies about size, paths that leave, shapes and numbers at the ends of their ranges
TRAPS: list[Any] = [
    "", "x", "nan", "../../x", "/etc/passwd", "a/../../b", "\0", "a\nb", "x" * 3000, -1, 0, 1, 10**6, 2**31, 2**63, -(2**63), 1e308, -1e308, 5e-324, -0.0,
    math.nan, math.inf, -math.inf, [], {}, [[]], [0, 0, 0], [1e308, 1e308, 1e308], [0] * 16, [[0.0] * 4] * 4, [math.nan] * 3, True, False,
]  # fmt: skip
_LEAF = st.sampled_from(TRAPS) | st.integers() | st.floats() | st.text(max_size=8) | st.booleans()
_VALUE = st.recursive(
    _LEAF, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=3), max_leaves=6
)
_ACCIDENT = st.tuples(st.integers(0, 10**6), st.sampled_from(["put", "put", "put", "lose", "foreign", "double", "bury"]), _VALUE)


def _places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Every container and key of the tree."""
    for key in list(tree) if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ():
        yield tree, key
        yield from _places(tree[key])


def after(tree: Any, accidents: list[tuple[int, str, Any]]) -> Any:
    """A copy of the tree after these accidents."""
    tree = copy.deepcopy(tree)
    for number, kind, value in accidents:
        places = list(_places(tree))
        if not places:
            return tree
        holder, key = places[number % len(places)]
        if kind == "put":
            holder[key] = copy.deepcopy(value)
        elif kind == "lose":
            del holder[key]
        elif kind == "foreign" and isinstance(holder, dict):
            holder["of no meaning"] = copy.deepcopy(value)
        elif kind == "double" and isinstance(holder, list):
            holder += copy.deepcopy(holder)
        else:
            holder[key] = {"value": holder[key]} if number % 2 else [holder[key]]
    return tree


def toml(value: Any) -> str:
    """A value in TOML; tables are written inline."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_quoted(str(key))} = {toml(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return _quoted(value) if isinstance(value, str) else repr(value)


def _quoted(text: str) -> str:
    # TOML wants DEL escaped too, and has no lone surrogates
    return json.dumps(text.encode("utf-8", "replace").decode(), ensure_ascii=False).replace("\x7f", "\\u007f")


def _entry(group: str, name: str, folder) -> Entry:
    return next(entry for entry in GROUPS[group](folder) if entry.name == name)


@pytest.mark.parametrize(("group", "name"), [(group, name) for group, names in TREES.items() for name in names])
def test_a_tree_that_was_spoilt_is_read_or_refused_in_one_line_that_names_its_file(group, name, tmp_path):
    entry = _entry(group, name, tmp_path)
    place = tmp_path / "fuzzed"
    place.mkdir(exist_ok=True)
    as_toml = name.endswith(".toml")
    trees = [tomllib.loads(good.decode()) if as_toml else json.loads(good) for good in entry.good]

    @seed(SEED)
    @settings(max_examples=EXAMPLES, database=None, suppress_health_check=list(HealthCheck))
    @given(st.integers(0, len(trees) - 1), st.lists(_ACCIDENT, min_size=1, max_size=4))
    def whatever_happened(which: int, accidents: list[tuple[int, str, Any]]) -> None:
        tree = after(trees[which], accidents)
        text = "".join(f"{_quoted(key)} = {toml(value)}\n" for key, value in tree.items()) if as_toml else json.dumps(tree)
        (place / name).write_text(text, encoding="utf-8")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                entry.read(place / name)
        except RangecheckError as error:
            assert "\n" not in str(error)
            assert name in str(error) or place.name in str(error)

    whatever_happened()
