"""Many callers of one head, large enough that its loops are shared among threads; which processors count."""

from __future__ import annotations

import importlib.resources
import os
import subprocess
import sys
import threading

import numpy as np
import pytest

import saccade

NUM_CALLERS = 8
NUM_VL_TOKENS = 56


def load(num_threads: int) -> saccade.ActionHead:
    with importlib.resources.as_file(saccade.demo_checkpoint()) as folder:
        return saccade.ActionHead.from_pretrained(folder, num_threads=num_threads)


@pytest.mark.parametrize("num_threads", [1, 2, 5])
def test_callers_at_the_same_time_get_the_bits_of_one_alone(num_threads: int) -> None:
    head = load(num_threads)
    generator = np.random.default_rng(0)
    features = generator.standard_normal((NUM_CALLERS, 1, NUM_VL_TOKENS, 128), dtype=np.float32)
    states = generator.standard_normal((NUM_CALLERS, 1, 4), dtype=np.float32)
    alone = load(1)
    contexts = [alone.encode(each) for each in features]
    expected = [
        alone.sample(contexts[caller], states[caller], 0, seed=caller, num_samples=1 + caller % 3)
        for caller in range(NUM_CALLERS)
    ]
    shared = head.encode(features[0])
    wrong: list[int] = []

    def work(caller: int) -> None:
        for index in range(6):
            # Every third chunk is from one context that all share, the others while somebody encodes.
            own = index % 3 != 0
            context = head.encode(features[caller]) if own else shared
            seen = caller if own else 0
            actions = head.sample(context, states[seen], 0, seed=seen, num_samples=1 + seen % 3)
            if np.asarray(actions).tobytes() != np.asarray(expected[seen]).tobytes():
                wrong.append(caller)

    callers = [threading.Thread(target=work, args=(caller,)) for caller in range(NUM_CALLERS)]
    for thread in callers:
        thread.start()
    for thread in callers:
        thread.join()
    assert not wrong


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs Linux")
def test_the_default_counts_only_processors_that_may_be_used() -> None:
    code = (
        "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))});"
        "import saccade; print(saccade.show_config('dicts')['num_threads'])"
    )
    environment = {name: value for name, value in os.environ.items() if name != "SACCADE_NUM_THREADS"}
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert (finished.stdout, finished.stderr) == ("1\n", "")
