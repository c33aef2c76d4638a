"""Frames as files that can be interrupted anywhere and taken up again with the same bytes.

A folder holds the frames of one job only. Its manifest, frames.json, states the job's key - a hash of everything that determines
the pictures - the exposure that all of them share, and the hash of each finished frame. A frame counts as finished when its file
has that hash; anything else is made again.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.errors import InputError, OutputError
from rangecheck.files import read_json, sha256, write_bytes, write_json
from rangecheck.kernels import alone, thread_count

MANIFEST = "frames.json"
SCHEMA = "rangecheck/frames/1"
#: frames that are looked at to choose the exposure, evenly spread over the sequence
PILOTS = 4


def key_of(determinants: Mapping[str, Any]) -> str:
    """Hex key of everything that determines a job's frames: JSON values, arrays, bytes, and nests of them, by name."""
    digest = hashlib.sha256()

    def feed(value: Any) -> None:
        if isinstance(value, Mapping):
            digest.update(b"{%d" % len(value))
            for name in sorted(value, key=str):
                feed(str(name))
                feed(value[name])
        elif isinstance(value, np.ndarray):
            digest.update(f"a{value.dtype.str}{value.shape}".encode())
            digest.update(np.ascontiguousarray(value).tobytes())
        elif isinstance(value, bytes):
            digest.update(b"b%d:" % len(value) + value)
        elif isinstance(value, (list, tuple)):
            digest.update(b"[%d" % len(value))
            for item in value:
                feed(item)
        elif isinstance(value, np.generic):
            feed(value.item())
        else:
            text = json.dumps(value)
            digest.update(f"{type(value).__name__}{len(text)}:{text}".encode())

    feed(determinants)
    return digest.hexdigest()


def pilot_indices(frames: int, pilots: int = PILOTS) -> list[int]:
    """The frames an exposure is taken from: `pilots` of them (or all), evenly spread, the same for every run."""
    count = min(frames, pilots)
    return [k * frames // count for k in range(count)]


def frame_name(index: int, frames: int, suffix: str = ".png") -> str:
    """frame_0007.png: numbers padded so that names sort as they play."""
    return f"frame_{index:0{max(4, len(str(frames - 1)))}d}{suffix}"


#: makes frames of the given numbers, wherever, and yields (number, radiance) as they are ready, in any order
Spread = Callable[[Sequence[int]], Iterator[tuple[int, FloatArray]]]


def render_frames(
    frame: Callable[[int], FloatArray],
    frames: int,
    folder: str | Path,
    key: str | Mapping[str, Any],
    *,
    encode: Callable[[FloatArray, float, int], bytes],
    exposure: Callable[[Sequence[FloatArray]], float] | float = 1.0,
    suffix: str = ".png",
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
    spread: Spread | None = None,
    abreast: int = 64,
    stands: Callable[[int], None] | None = None,
) -> list[Path]:
    """Make frames 0..frames-1 as files in `folder`, or those of them that are missing, and return their paths in order.

    frame(index) is the radiance of one frame, a pure function of its number; encode(radiance, exposure, index) is its file. `exposure`
    is a number, or a function of the pilot frames' radiances, asked once before the first frame is written and then kept in the
    manifest. progress(done, frames) is called after each frame, stands(index) for each whose file is whole, at once for those that were
    there. At most `abreast` frames are in the making at once, each on a thread of its own; with 1 all threads make one. An interruption
    leaves only whole files, and the next call with the same key goes on to the same bytes. With `spread` (see `farm`) frames are made elsewhere, and `frame` is not called here.

    Raises OutputError when the folder holds frames of another job, or frames without a manifest, unless `force`, which removes
    them first."""
    where = Path(folder)
    job = key if isinstance(key, str) else key_of(key)
    manifest = _taken_up(where, job, frames, suffix, force)
    paths = [where / frame_name(i, frames, suffix) for i in range(frames)]
    done: dict[str, str] = manifest["done"]
    missing = [i for i, path in enumerate(paths) if not _finished(path, done.get(path.name))]
    if progress is not None:
        progress(frames - len(missing), frames)
    made = spread if spread is not None else _abreast(frame, abreast) if abreast > 1 else _one_after_the_other(frame)
    if stands is not None:
        for index in sorted(set(range(frames)) - set(missing)):
            stands(index)
    kept: dict[int, FloatArray] = {}
    if missing and manifest["exposure"] is None:
        if callable(exposure):
            kept = dict(sorted(made(pilot_indices(frames))))
            manifest["exposure"] = float(exposure(list(kept.values())))
        else:
            manifest["exposure"] = float(exposure)
    level = manifest["exposure"]

    def write(index: int, radiance: FloatArray) -> None:
        content = encode(radiance, level, index)
        # a frame that a loss of power damages has another hash, and is made again: nobody need wait for the disk
        write_bytes(paths[index], content, durable=False)
        done[paths[index].name] = hashlib.sha256(content).hexdigest()
        write_json(where / MANIFEST, manifest | {"done": dict(sorted(done.items()))}, durable=len(done) in (1, frames))
        if stands is not None:
            stands(index)

    ready = chain(
        ((index, kept.pop(index)) for index in missing if index in kept), made([index for index in missing if index not in kept])
    )
    # while one frame is traced the last one is encoded; one writer keeps the manifest in order
    with ThreadPoolExecutor(1, thread_name_prefix="frame-writer") as writer:
        writing: Future[None] | None = None
        for count, (index, radiance) in enumerate(ready):
            if writing is not None:
                writing.result()
                if progress is not None:
                    progress(frames - len(missing) + count, frames)
            writing = writer.submit(write, index, radiance)
        if writing is not None:
            writing.result()
            if progress is not None:
                progress(frames, frames)
    return paths


def _one_after_the_other(frame: Callable[[int], FloatArray]) -> Spread:
    return lambda indices: ((index, frame(index)) for index in indices)


def _abreast(frame: Callable[[int], FloatArray], most: int) -> Spread:
    """Frames in order, as many in the making as there are threads, each on one of its own, and as many that wait for their turn."""

    def one(index: int) -> FloatArray:
        with alone():
            return frame(index)

    def frames(indices: Sequence[int]) -> Iterator[tuple[int, FloatArray]]:
        threads = min(thread_count(), len(indices), most)
        if threads <= 1:
            yield from _one_after_the_other(frame)(indices)
            return
        with ThreadPoolExecutor(threads, thread_name_prefix="frame-maker") as pool:
            making: deque[tuple[int, Future[FloatArray]]] = deque()
            try:
                for index in indices:
                    if len(making) >= 2 * threads:
                        done, result = making.popleft()
                        yield done, result.result()
                    making.append((index, pool.submit(one, index)))
                while making:
                    done, result = making.popleft()
                    yield done, result.result()
            finally:
                for _, result in making:
                    result.cancel()

    return frames


def _finished(path: Path, expected: str | None) -> bool:
    return expected is not None and path.is_file() and sha256(path) == expected


def _taken_up(where: Path, job: str, frames: int, suffix: str, force: bool) -> dict[str, Any]:
    """The folder's manifest if it is this job's, else a new one in a folder without frames."""
    fresh = {"schema": SCHEMA, "key": job, "frames": frames, "suffix": suffix, "exposure": None, "done": {}}
    try:
        where.mkdir(parents=True, exist_ok=True)
        present = sorted(where.glob("frame_*"))
        for part in where.glob(".frame*.part*"):
            part.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(where, f"cannot be used for frames ({error.strerror}); choose a folder you may write to") from None
    manifest: Any = None
    if (where / MANIFEST).exists():
        with suppress(InputError):
            manifest = read_json(where / MANIFEST)
    if _is_ours(manifest, fresh):
        return fresh | {"exposure": manifest["exposure"], "done": manifest["done"]}
    if (present or manifest is not None) and not force:
        other = manifest.get("key") if isinstance(manifest, dict) else None
        whose = f"frames of another job (key {str(other)[:12]}, this one is {job[:12]})" if other else "frames of an unknown job"
        raise OutputError(
            where, f"holds {len(present)} {whose}; pass --force to replace them, or choose another folder", count=len(present)
        )
    for path in present:
        path.unlink(missing_ok=True)
    write_json(where / MANIFEST, fresh)
    return fresh


def _is_ours(manifest: Any, fresh: dict[str, Any]) -> bool:
    return (
        isinstance(manifest, dict)
        and all(manifest.get(name) == fresh[name] for name in ("schema", "key", "frames", "suffix"))
        and isinstance(manifest.get("done"), dict)
        and all(isinstance(digest, str) for digest in manifest["done"].values())
        and "exposure" in manifest
        and (manifest["exposure"] is None or (isinstance(manifest["exposure"], float) and 0 < manifest["exposure"] < math.inf))
    )
