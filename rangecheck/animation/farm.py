"""Frames on many machines: a dask.distributed cluster that was started by its own ordinary commands.

    dask scheduler            on one machine, dask worker tcp://that-machine:8786 on each
    Farm("tcp://that-machine:8786")

What describes the job travels once to each worker, where `build` makes the function of frame numbers out of it, once. A frame is a pure
function of its number, so a lost worker's frames are simply made again elsewhere, and the bytes are those of one core. Workers
must have the same version of rangecheck; what is sent are arrays and plain values, and functions by their names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from typing import Any

from rangecheck.animation.frames import Spread, key_of
from rangecheck.arrays import FloatArray
from rangecheck.errors import DependencyMissing, RangecheckError

#: frames asked for ahead, per thread of the cluster: enough to keep it busy, few enough to keep memory bounded
AHEAD = 2
#: a frame whose worker was lost this many times is given up: the frame itself kills workers
LOST_WORKERS = 4

Build = Callable[[Any], Callable[[int], FloatArray]]

_built: dict[str, Callable[[int], FloatArray]] = {}


def _make(token: str, build: Build, job: Any, index: int) -> FloatArray:
    """On a worker: frame `index` of the job known by `token`."""
    if token not in _built:
        _built.clear()
        _built[token] = build(job)
    return _built[token](index)


class Farm:
    """A cluster at `address` (tcp://host:port, tls://host:port with dask's own security settings). Close it, or use it with `with`.

    Raises DependencyMissing without the extra `distributed`, RangecheckError when nothing answers at the address."""

    def __init__(self, address: str, *, timeout_s: float = 10.0) -> None:
        try:
            from distributed import Client
        except ImportError:
            raise DependencyMissing("distributed", "frames on other machines", "pip install 'rangecheck[distributed]'") from None
        import dask

        self.address = address
        dask.config.set({"distributed.scheduler.allowed-failures": LOST_WORKERS})
        try:
            self.client = Client(address, timeout=timeout_s, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise RangecheckError(
                f"no dask scheduler answers at {address} ({error}); start one with `dask scheduler`, workers with `dask worker {address}`"
            ) from None

    def __enter__(self) -> Farm:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the cluster; it runs on."""
        self.client.close()

    def threads(self) -> int:
        """Threads of all workers now."""
        return sum(self.client.nthreads().values())

    def spread(self, build: Build, job: Any, key: Any) -> Spread:
        """For `render_frames(spread=...)`: frames of build(job), made on the cluster. `build` is a function of a module that the
        workers can import; `job` is sent to each worker once; `key` is what the job is known by (see `key_of`)."""
        token = key if isinstance(key, str) else key_of(key)

        def frames(indices: Sequence[int]) -> Iterator[tuple[int, FloatArray]]:
            from distributed import KilledWorker, as_completed

            if not len(indices):
                return
            self._need_workers()
            sent = self.client.scatter(job, broadcast=True, hash=False)
            waiting = list(indices)
            index_of: dict[str, int] = {}

            def ask() -> Any:
                index = waiting.pop(0)
                future = self.client.submit(_make, token, build, sent, index, pure=False, retries=LOST_WORKERS)
                index_of[future.key] = index
                return future

            first = [ask() for _ in range(min(len(waiting), AHEAD * max(1, self.threads())))]
            ready = as_completed(first, loop=self.client.loop)
            for future in ready:
                index = index_of.pop(future.key)
                try:
                    radiance = future.result()
                except (KilledWorker, CancelledError) as error:
                    raise RangecheckError(
                        f"frame {index} could not be made at {self.address} ({error}): it outlived {LOST_WORKERS} workers, or all that "
                        "held the job are gone; see their logs, then run again: finished frames are kept"
                    ) from None
                future.release()
                if waiting:
                    ready.add(ask())
                yield index, radiance

        return frames

    def _need_workers(self) -> None:
        if not self.threads():
            raise RangecheckError(f"the scheduler at {self.address} has no workers; start some with `dask worker {self.address}`")
