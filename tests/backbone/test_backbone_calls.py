"""Calls of a backbone at the same time, after a fork, interrupted, and without memory."""

from __future__ import annotations

import concurrent.futures
import os
import subprocess
import sys

import numpy as np
import pytest

import saccade
from tests.helpers.interrupts import Stopped, stopped_after
from tests.helpers.released_backbones import DATA, released_backbone


def test_threads_may_call_at_the_same_time() -> None:
    names = ("n15_one_view", "n15_two_views", "n15_batch_padded")
    backbone = released_backbone(names[0]).load("int8", num_threads=2)
    inputs = [released_backbone(name).inputs() for name in names]
    alone = [backbone(given) for given in inputs]

    def call(index: int) -> bool:
        which = index % len(inputs)
        features = backbone(inputs[which], previous=alone[(index // 3) % 3] if index % 2 else None)
        return np.array_equal(features.backbone_features, alone[which].backbone_features)

    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        assert all(pool.map(call, range(24)))


def test_a_forked_process_has_the_same_features() -> None:
    released = released_backbone("n15_one_view")
    backbone = released.load(num_threads=2)
    expected = backbone(released.inputs())
    child = os.fork()
    if child == 0:
        features = backbone(released.inputs(), previous=expected)
        again = backbone(released.inputs())
        same = [
            np.array_equal(one.backbone_features, expected.backbone_features) for one in (features, again)
        ]
        os._exit(0 if all(same) else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_calls_are_stopped_and_the_backbone_stays_usable() -> None:
    released = released_backbone("n15_pixel_shuffle")
    backbone = released.load()
    few = backbone(released.inputs()).backbone_features
    count = 2000
    many = saccade.BackboneInputs(
        np.tile(released.pixel_values, (count, 1, 1, 1)),
        np.tile(released.arrays["_in.input_ids"], (count, 1)),
        np.tile(released.arrays["_in.attention_mask"], (count, 1)),
    )

    def call_again_and_again() -> None:
        while True:
            backbone(many)

    def load_again_and_again() -> None:
        while True:
            released.load()

    for delay in (0.02, 0.1, 0.3):
        with pytest.raises(Stopped), stopped_after(delay):
            call_again_and_again()
        assert np.array_equal(backbone(released.inputs()).backbone_features, few)
    with pytest.raises(Stopped), stopped_after(0.1):
        load_again_and_again()


WITHOUT_MEMORY = """
import json, resource, sys
import numpy as np
from safetensors import safe_open
import saccade

path = sys.argv[1]
with safe_open(path, framework="np") as file:
    about = json.loads(file.metadata()["about"])
    ids, pixels = file.get_tensor("_in.input_ids"), file.get_tensor("_in.pixel_values")
backbone = saccade.Backbone.from_pretrained(path, config=about, num_threads=1)
expected = backbone(saccade.BackboneInputs(pixels, ids)).backbone_features
count = 1500
many = saccade.BackboneInputs(np.tile(pixels, (count, 1, 1, 1)), np.tile(ids, (count, 1)))
# Room for small allocations: where they are refused too, Rust ends the process, and no program could go on.
holes = [bytes(1000) for _ in range(4000)]
del holes[::2]
with open("/proc/self/statm") as file:
    used = int(file.read().split()[0]) * resource.getpagesize()
refused = 0
for megabytes in range(1, 60, 3):
    resource.setrlimit(resource.RLIMIT_AS, (used + megabytes * 2**20, resource.RLIM_INFINITY))
    try:
        backbone(many)
    except MemoryError as error:
        assert "bytes" in str(error) or "Unable to allocate" in str(error), error
        refused += 1
assert refused > 10, refused
resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
assert np.array_equal(backbone(saccade.BackboneInputs(pixels, ids)).backbone_features, expected)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits the address space")
def test_memory_that_the_system_refuses() -> None:
    path = DATA / "n15_one_view.safetensors"
    done = subprocess.run([sys.executable, "-c", WITHOUT_MEMORY, str(path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
