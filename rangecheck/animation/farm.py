"""Frames on many machines: a dask.distributed cluster that was started by its own ordinary commands.

    dask scheduler            on one machine, dask worker tcp://that-machine:8786 on each
    Farm("tcp://that-machine:8786")

What describes the job travels once to each worker, where `build` makes the function of frame numbers out of it, once. A frame is a pure
function of its number, so a lost worker's frames are simply made again elsewhere, and the bytes are those of one core. When all that
held the job are gone, it is sent once more to those that are left. Workers must have the same version of rangecheck; what is sent are
arrays and plain values, and functions by their names. Each of a worker's threads makes one frame at a time, alone.
"""

from __future__ import annotations

import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from typing import Any, TypeVar

from rangecheck import kernels
from rangecheck.animation.frames import key_of
from rangecheck.errors import DependencyMissing, RangecheckError

#: frames asked for ahead, per thread of the cluster: enough to keep it busy, few enough to keep memory bounded
AHEAD = 2
#: a frame whose worker was lost this many times is given up: the frame itself kills workers
LOST_WORKERS = 4
#: workers that were lost are waited for at least so long: those that look after them start new ones, which takes ten seconds on two busy cores
RESTART_S = 60.0

J = TypeVar("J")
T = TypeVar("T")

_built: dict[str, Callable[[int], Any]] = {}
_building = threading.Lock()


def _make(token: str, build: Callable[[J], Callable[[int], T]], job: J, index: int) -> T:
    """On a worker: frame `index` of the job known by `token`."""
    with _building:
        if token not in _built:
            # a worker's threads are the cluster's to count
            kernels.set_threads(1)
            _built.clear()
            _built[token] = build(job)
        make: Callable[[int], T] = _built[token]
    return make(index)


class Farm:
    """A cluster at `address` (tcp://host:port, tls://host:port with dask's own security settings). Close it, or use it with `with`.

    Raises DependencyMissing without the extra `distributed`, RangecheckError when nothing answers at the address."""

    def __init__(self, address: str, *, timeout_s: float = 10.0) -> None:
        try:
            from distributed import Client
        except ImportError:
            raise DependencyMissing("distributed", "frames on other machines", "pip install 'rangecheck[distributed]'") from None
        import dask

        if not re.fullmatch(r"([a-z]+://)?\S+:\d+", address) and not address.startswith("inproc://"):
            raise RangecheckError(
                f"{address!r} is no address of a dask scheduler; write tcp://HOST:PORT, for example tcp://10.0.0.1:8786"
            )
        self.address, self.timeout_s = address, timeout_s
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

    def spread(
        self, build: Callable[[J], Callable[[int], T]], job: J, key: str | Mapping[str, Any]
    ) -> Callable[[Sequence[int]], Iterator[tuple[int, T]]]:
        """For `render_frames(spread=...)`: frames of build(job), made on the cluster. `build` is a function of a module that the
        workers can import; `job` is sent to each worker once; `key` is what the job is known by (see `key_of`)."""
        token = key if isinstance(key, str) else key_of(key)

        def frames(indices: Sequence[int]) -> Iterator[tuple[int, T]]:
            from distributed import KilledWorker, as_completed

            if not len(indices):
                return
            sent = self._sent(job)
            waiting = list(indices)
            asked: dict[str, tuple[int, Any]] = {}
            lost: Counter[int] = Counter()

            def ask(index: int) -> Any:
                future = self.client.submit(_make, token, build, sent, index, pure=False, retries=LOST_WORKERS)
                asked[future.key] = index, sent
                return future

            ahead = AHEAD * max(1, self.threads())
            first, waiting = waiting[:ahead], waiting[ahead:]
            ready = as_completed([ask(index) for index in first], loop=self.client.loop)
            for future in ready:
                index, held = asked.pop(future.key)
                try:
                    result = future.result()
                except CancelledError as error:
                    # what the frame was to be made of is gone with its workers
                    lost[index] += 1
                    if lost[index] >= LOST_WORKERS:
                        raise self._given_up(index, error) from None
                    if held is sent:
                        sent = self._sent(job, again=True)
                    ready.add(ask(index))
                    continue
                except KilledWorker as error:
                    raise self._given_up(index, error) from None
                future.release()
                if waiting:
                    ready.add(ask(waiting.pop(0)))
                yield index, result

        return frames

    def _sent(self, job: J, *, again: bool = False) -> Any:
        """The job on one worker, from which each other fetches it once when its first frame is asked for; workers may be lost while it
        travels. Not on all at once: while it replicates what is scattered, the scheduler tries a lost worker for ever
        (distributed 2026.8)."""
        for attempt in range(LOST_WORKERS):
            self._need_workers(max(self.timeout_s, RESTART_S) if again or attempt else self.timeout_s)
            try:
                return self.client.scatter(job, hash=False)
            except (OSError, TimeoutError) as error:
                lost = error
                time.sleep(0.1 * 2**attempt)
        raise RangecheckError(
            f"the job could not be sent to the workers at {self.address} ({lost}); see their logs, then run again"
        )

    def _given_up(self, index: int, error: BaseException) -> RangecheckError:
        return RangecheckError(
            f"frame {index} could not be made at {self.address} ({error}): it outlived {LOST_WORKERS} workers; see "
            "their logs, then run again: finished frames are kept"
        )

    def _need_workers(self, timeout_s: float) -> None:
        """Workers that were started a moment ago are waited for."""
        try:
            self.client.wait_for_workers(1, timeout=timeout_s)
        except TimeoutError:
            raise RangecheckError(
                f"the scheduler at {self.address} has no workers; start some with `dask worker {self.address}`"
            ) from None
