"""Interventions and calls with them, random and of every kind at once, for tests of the Rust head."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import saccade
from saccade import Intervention
from saccade.head.config import HeadConfig
from saccade_lab.reference import ActionHead as Reference
from saccade_lab.reference.random_weights import random_inputs
from tests.helpers.engine_cases import arrays, both, configs
from tests.helpers.reference_cases import small_config

ROWS = ("state", "future", "action")


@dataclass(frozen=True)
class Sizes:
    """What the indices of an intervention may point to."""

    config: HeadConfig
    batch: int
    num_vl_tokens: int
    num_steps: int
    num_future: int

    def count(self, group: str) -> int:
        """Tokens of a group."""
        counts = {"state": 1, "future": self.num_future, "action": self.config.action_horizon}
        return counts.get(group, self.num_vl_tokens)


def some_indices(count: int) -> st.SearchStrategy[tuple[int, ...]]:
    return st.lists(st.integers(0, count - 1), unique=True, min_size=1, max_size=4).map(tuple)


def tokens(sizes: Sizes, groups: Sequence[str]) -> st.SearchStrategy[Any]:
    """A group that has tokens, or some of them."""
    group = st.sampled_from([name for name in groups if sizes.count(name) > 0])
    return group | group.flatmap(lambda name: st.tuples(st.just(name), some_indices(sizes.count(name))))


@st.composite
def interventions(draw: st.DrawFn, sizes: Sizes) -> Intervention:
    """Cuts, biases and patches of whole groups and of single tokens, everywhere or not."""
    rng = np.random.default_rng(draw(st.integers(0, 2**31 - 1)))

    def count(chosen: Any) -> int:
        return sizes.count(chosen) if isinstance(chosen, str) else len(chosen[1])

    def bias(chosen: Any) -> float | NDArray[np.float32]:
        if draw(st.booleans()):
            return draw(st.sampled_from([-math.inf, -1.5, 0.0, 0.7, 2.0]))
        values = rng.standard_normal(count(chosen)).astype(np.float32)
        return np.where(rng.random(values.shape) < 0.2, np.float32(-np.inf), values)

    def rows(chosen: Any) -> NDArray[np.float32]:
        batch = (sizes.batch,) if draw(st.booleans()) else ()
        return rng.standard_normal((*batch, count(chosen), sizes.config.width)).astype(np.float32)

    def limit(count: int) -> tuple[int, ...] | None:
        return draw(st.none() | some_indices(count))

    config = sizes.config
    pairs = st.tuples(tokens(sizes, ROWS), tokens(sizes, (*ROWS, "vl")))
    places = st.tuples(st.integers(0, sizes.num_steps - 1), st.integers(0, config.num_layers - 1))
    patched = draw(st.lists(st.tuples(places, tokens(sizes, ROWS)), max_size=2))
    biased = draw(st.lists(tokens(sizes, (*ROWS, "vl")), max_size=3))
    blocks = limit(config.num_layers)
    return Intervention(
        cut=[pair for pair in draw(st.lists(pairs, max_size=3)) if acts_somewhere(config, pair[1], blocks)],
        key_bias={chosen: bias(chosen) for chosen in biased if acts_somewhere(config, chosen, blocks)},
        patch={place: {chosen: rows(chosen)} for place, chosen in patched},
        blocks=blocks,
        steps=limit(sizes.num_steps),
        heads=limit(config.num_heads),
    )


def acts_somewhere(config: HeadConfig, keys: Any, blocks: Sequence[int] | None) -> bool:
    """Whether these keys exist in any of these blocks: `vl` in cross-attention, others in self-attention."""
    group = keys if isinstance(keys, str) else keys[0]
    chosen = range(config.num_layers) if blocks is None else blocks
    is_self = {block % 2 == 1 and config.interleave_self_attention for block in chosen}
    return (group != "vl") in is_self


# The instruction set is set once for all of a test's examples.
per_isa = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], max_examples=25
)


@dataclass(frozen=True)
class Case:
    """A head twice, one call of it, and what to change."""

    head: saccade.ActionHead
    reference: Reference
    inputs: dict[str, Any]  # tensors: features, state, noise, embodiment_id
    drop_vl: NDArray[np.bool_] | None
    num_steps: int
    interventions: list[Intervention]


@st.composite
def cases(draw: st.DrawFn, max_steps: int) -> Case:
    """Any sizes; 100 and 200 tokens are more than the attention kernel takes in one block of keys."""
    config, seed = draw(configs()), draw(st.integers(0, 2**31 - 1))
    batch, num_vl_tokens = draw(st.integers(1, 3)), draw(st.sampled_from([1, 2, 7, 33, 100, 200]))
    num_future = draw(st.none() | st.sampled_from([0, 1, 3, 9]))
    num_steps = draw(st.integers(1, max_steps))
    head, reference = both(config, seed)
    rng = np.random.default_rng(seed)
    replaced = []
    if num_future is not None:
        replaced = [Intervention(future_tokens=rng.standard_normal((num_future, head.config.width)))]
    count = head.config.num_future_tokens if num_future is None else num_future
    sizes = Sizes(head.config, batch, num_vl_tokens, num_steps, count)
    return Case(
        head,
        reference,
        random_inputs(head.config, seed, batch=batch, num_vl_tokens=num_vl_tokens),
        rng.random((batch, num_vl_tokens)) < 0.4 if draw(st.booleans()) else None,
        num_steps,
        draw(st.lists(interventions(sizes), min_size=1, max_size=2)) + replaced,
    )


Head = saccade.ActionHead
Inputs = dict[str, Any]


def small_head(isa: str) -> Head:
    """A head whose sizes all differ, on the instruction set that the fixture `isa` chose."""
    head, _ = both(small_config(num_layers=4, vl_num_layers=1), seed=11)
    assert head.isa == isa
    return head


def inputs_of(head: Head) -> Inputs:
    """What `sample` of this head takes, for three observations."""
    given_arrays = arrays(random_inputs(head.config, 12, batch=3, num_vl_tokens=6))
    given_arrays["context"] = head.encode(given_arrays.pop("backbone_features"))
    return given_arrays


def everything(head: Head, batch: int) -> list[Intervention]:
    """All kinds of changes at once, for this batch."""
    rng = np.random.default_rng(1)
    width, horizon = head.config.width, head.config.action_horizon
    return [
        Intervention(cut=[("action", ("vl", [0, 3])), (("future", [1]), "action")], heads=[0, 2]),
        Intervention(key_bias={"state": 0.5, ("vl", (1,)): -1.0}, steps=[0, 2]),
        Intervention(future_tokens=rng.standard_normal((6, width))),
        Intervention(
            patch={
                (0, 2): {("future", (4, 0)): rng.standard_normal((2, width))},
                (2, 3): {"action": rng.standard_normal((batch, horizon, width))},
                (1, 1): {"state": rng.standard_normal((batch, 1, width))},
            }
        ),
    ]
