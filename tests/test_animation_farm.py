"""Frames made on a cluster are the frames made at home, even when a worker dies."""

import os
import signal
import warnings

import pytest

from rangecheck.animation import render_frames
from rangecheck.animation.farm import Farm
from rangecheck.errors import RangecheckError

pytest.importorskip("distributed", reason="the optional package distributed is not installed")

FRAMES = 12


def encode(image, exposure, index=0):
    return (image * exposure).tobytes()


def exposure(pilots):
    return 1 / max(p.max() for p in pilots)


def content(folder):
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def cluster():
    """Two worker processes on this machine, which can import the job."""
    from distributed import LocalCluster

    with warnings.catch_warnings():
        # forked helpers of the cluster itself and its event loop's clean-up warn about things that are not ours
        warnings.simplefilter("ignore")
        with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50) as running:
            yield running


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_killed_workers_frames_are_made_again_with_the_same_bytes(cluster, tmp_path):
    from farm_job import noisy_frames

    at_home = noisy_frames({"seed": 3})
    render_frames(at_home, FRAMES, tmp_path / "home", "job", encode=encode, exposure=exposure)
    flag = tmp_path / "died"
    with Farm(cluster.scheduler_address) as farm:
        spread = farm.spread(noisy_frames, {"seed": 3, "dies_once": str(flag)}, "job")
        seen = []
        render_frames(
            at_home,
            FRAMES,
            tmp_path / "away",
            "job",
            encode=encode,
            exposure=exposure,
            spread=spread,
            progress=lambda *n: seen.append(n),
        )
    assert flag.exists()
    assert content(tmp_path / "away") == content(tmp_path / "home")
    assert seen[0] == (0, FRAMES) and seen[-1] == (FRAMES, FRAMES)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_job_whose_every_holder_died_is_sent_again(cluster):
    from farm_job import slow_numbers

    with Farm(cluster.scheduler_address) as farm:
        found = {}
        for index, value in farm.spread(slow_numbers, {"times": 3}, "slow")(range(FRAMES)):
            found[index] = value
            if len(found) == 3:
                for process in farm.client.run(os.getpid).values():
                    os.kill(process, signal.SIGKILL)
    assert found == {index: 3 * index for index in range(FRAMES)}


@pytest.mark.filterwarnings("ignore")
def test_an_address_where_nothing_answers_is_said():
    with pytest.raises(RangecheckError, match="start one with `dask scheduler`"):
        Farm("tcp://127.0.0.1:9", timeout_s=1.0)
