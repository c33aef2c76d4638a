"""Readers answer damaged files with our errors: no crash, no hang over 5 s, no allocation over 1 GB.

Some hundreds of inputs run with the other tests. The full run: RANGECHECK_FUZZ=20000 pytest tests/fuzz
"""

from __future__ import annotations

import os
import resource
import struct
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np

from fuzz.mutate import companion, corpus, mutated
from rangecheck.errors import RangecheckError
from rangecheck.scan.readers import read_measured

COUNT = int(os.environ.get("RANGECHECK_FUZZ", "400"))
SEED = int(os.environ.get("RANGECHECK_FUZZ_SEED", "1"))
LONGEST_S, MOST_BYTES = 5.0, 1 << 30


def good_pages(content: bytes) -> bytes:
    """E57 content with checksums that fit again, so that what lies behind them is reached."""
    from test_readers_e57 import crc_pages

    logical = b"".join(content[k : k + 1020] for k in range(0, len(content), 1024))
    paged = crc_pages(logical)
    if len(paged) >= 24:
        logical = logical[:16] + struct.pack("<Q", len(paged)) + logical[24:]
        paged = crc_pages(logical)
    return paged


def feed(folder: Path, count: int, seed: int) -> dict[str, int]:
    """Feed `count` mutated files to the readers; how many were read and how many refused, by file name."""
    random = np.random.default_rng(seed)
    files = corpus(folder / "corpus")
    for name in ("good.png", "good.ply"):
        (folder / name).write_bytes(files[name])
    names = [n for n in files if not n.startswith("good")]
    others, told = list(files.values()), {}
    for name in names:  # what is not mutated is read; this also compiles what the clock must not count
        run(folder, name, files[name], expect=True)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for k in range(count):
        name = names[k % len(names)]
        content = mutated(files[name], random, others)
        if name.endswith(".e57") and random.random() < 0.8:
            content = good_pages(content)
        start = time.process_time()
        read = run(folder, name, content)
        spent = time.process_time() - start
        assert spent < LONGEST_S, f"{name}, input {k} of seed {seed}: {spent:.1f} s"
        told[f"{name} {'read' if read else 'refused'}"] = told.get(f"{name} {'read' if read else 'refused'}", 0) + 1
        grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
        assert grown < MOST_BYTES, f"{name}, input {k} of seed {seed}: grew by {grown} bytes"
    return told


def run(folder: Path, name: str, content: bytes, expect: bool = False) -> bool:
    path = folder / f"fuzzed{Path(name).suffix}"
    path.write_bytes(content)
    beside = companion(name)
    if beside is not None:
        path.with_suffix(".json").write_bytes(beside)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            scans = read_measured(
                path, None if path.suffix in (".npz", ".json", ".png", ".tif", ".exr", ".pfm", ".cyb", ".pcd") else "mm"
            )
    except RangecheckError as error:
        assert "\n" not in str(error), f"{name}: more than one line: {error}"
        assert path.stem in str(error), f"{name}: the message does not name it: {error}"
        assert not expect, f"{name} is good and was refused: {error}"
        return False
    assert scans
    return True


def test_damaged_files_are_answered_in_time_and_in_one_line(tmp_path):
    """In a process of its own: a crash of a decoder written in C is a failure here, not the end of the run."""
    code = f"from pathlib import Path; from fuzz.test_readers_fuzz import feed; print(feed(Path({str(tmp_path)!r}), {COUNT}, {SEED}))"
    root = Path(__file__).resolve().parents[1]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, timeout=60 + COUNT)
    assert done.returncode == 0, (done.stderr or done.stdout)[-3000:]
    assert done.stderr == "", f"a decoder wrote to stderr: {done.stderr[:400]}"
