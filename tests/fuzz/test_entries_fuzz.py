"""Whatever else is read from files answers damage with our errors: no crash, no hang over 5 s, no more than 1 GB beside what is loaded.

Some hundreds of inputs run with the other tests. The full run, with counts: RANGECHECK_FUZZ=20000 pytest tests/fuzz/test_entries_fuzz.py -s;
RANGECHECK_FUZZ_GROUP (meshes, settings, scenes, documents, pictures) takes one group, RANGECHECK_FUZZ_SEED draws others. An input that is answered wrongly is kept, and named.
"""

from __future__ import annotations

import faulthandler
import os
import resource
import subprocess
import sys
import time
import traceback
import warnings
from pathlib import Path

import numpy as np

from fuzz.entries import GROUPS, spoilt
from rangecheck.errors import RangecheckError

COUNT = int(os.environ.get("RANGECHECK_FUZZ", "80"))
CHOSEN = [os.environ["RANGECHECK_FUZZ_GROUP"]] if "RANGECHECK_FUZZ_GROUP" in os.environ else [*GROUPS]
SEED = int(os.environ.get("RANGECHECK_FUZZ_SEED", "1"))
LONGEST_S, MOST_BYTES = 5.0, 1 << 30


def feed(group: str, folder: Path, count: int, seed: int) -> None:
    """Feed `count` spoilt files of a group; prints how many of each kind were read and refused, and exits with those answered wrongly."""
    random = np.random.default_rng(seed)
    entries = GROUPS[group](folder)
    place = folder / "fuzzed"
    place.mkdir(exist_ok=True)
    told: dict[str, int] = {}
    wrong: dict[str, str] = {}
    for entry in entries:  # what is good is read; this also loads and compiles what is not to be counted
        for good in entry.good:
            (place / entry.name).write_bytes(good)
            entry.read(place / entry.name)
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (held + MOST_BYTES, resource.RLIM_INFINITY))
    for k in range(count):
        entry = entries[k % len(entries)]
        path = place / entry.name
        content = spoilt(entry, random)
        path.write_bytes(content)
        faulthandler.dump_traceback_later(60, exit=True)
        start, fault = time.process_time(), ""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                entry.read(path)
            answer = "read"
        except RangecheckError as error:
            answer = "refused"
            fault = "more than one line" if "\n" in str(error) else ""
            # what is given on the command line has no file
            if entry.name != "set.txt" and path.name not in str(error) and place.name not in str(error):
                fault = f"the message does not name the file: {error}"
        except BaseException as error:
            answer = "wrong"
            fault = f"{type(error).__name__} at {traceback.extract_tb(error.__traceback__)[-1]}: {str(error)[:200]}"
        if time.process_time() - start > LONGEST_S:
            fault = f"{time.process_time() - start:.1f} s"
        faulthandler.cancel_dump_traceback_later()
        told[f"{entry.name} {answer}"] = told.get(f"{entry.name} {answer}", 0) + 1
        if fault and f"{entry.name}: {fault}" not in wrong:
            kept = folder / f"wrong_{len(wrong)}_{entry.name}"
            kept.write_bytes(content)
            wrong[f"{entry.name}: {fault}"] = str(kept)
        path.unlink(missing_ok=True)  # a job that is taken up takes its mark away
    print(f"{group}, {count} inputs of seed {seed}: {told}")
    if wrong:
        sys.exit("\n".join(f"{fault} ({kept})" for fault, kept in wrong.items()))


def test_damaged_files_of_every_other_kind_are_answered_in_time_and_in_one_line(tmp_path):
    """In a process of its own: a crash of a decoder written in C is a failure here, not the end of the run."""
    code = "from pathlib import Path\nfrom fuzz.test_entries_fuzz import feed\n"
    for group in CHOSEN:
        (tmp_path / group).mkdir()
        code += f"feed({group!r}, Path({str(tmp_path / group)!r}), {COUNT}, {SEED})\n"
    root = Path(__file__).resolve().parents[1]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, timeout=60 + COUNT)
    print(done.stdout)
    assert done.returncode == 0, (done.stderr or done.stdout)[-3000:]
