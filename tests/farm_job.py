"""A job for the workers of a farm: importable by name, as a real one must be."""

import os
import signal
import time
from pathlib import Path

import numpy as np


def noisy_frames(job):
    """Frames of noise; where `job` names a flag file that does not exist yet, frame 5 makes it and kills its own worker."""

    def frame(index):
        flag = job.get("dies_once")
        if index == 5 and flag and not Path(flag).exists():
            Path(flag).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return np.random.default_rng([job["seed"], index]).uniform(0.1, 1.0, (16, 16))

    return frame


def slow_numbers(job):
    """Each number times job["times"], a tenth of a second later."""

    def number(index):
        time.sleep(0.1)
        return index * job["times"]

    return number
