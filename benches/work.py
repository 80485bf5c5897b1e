"""The work of one call by part, computed from the head's sizes: multiply-adds, and weights that are read.

The parts are those of the engine's profile; a test compares the counts of both.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from saccade.head.config import HeadConfig
from saccade_lab.timing import Call

#: Parts whose operands are keys, values and probabilities rather than weights.
ATTENTION = ("attention",)


@dataclass
class Work:
    """The work of one part of a call.

    Attributes:
        multiply_adds: Number of multiply-adds of its matrix products.
        elements: Weights, or cached keys and values, that it reads at least once for each product.
        rows: Rows of activations, summed over its products.
    """

    multiply_adds: int = 0
    elements: int = 0
    rows: int = 0

    def __add__(self, other: Work) -> Work:
        return Work(
            self.multiply_adds + other.multiply_adds,
            self.elements + other.elements,
            self.rows + other.rows,
        )


Works = dict[str, Work]


def encode_work(config: HeadConfig, call: Call) -> Works:
    """`ActionHead.encode`: the VL self-attention, and keys and values of every cross-attention block."""
    rows, width = call.batch * call.num_vl_tokens, config.context_dim
    works: Works = {}
    for _ in range(config.vl_num_layers):
        add_linear(works, "to_q", rows, width, width)
        add_linear(works, "to_kv", rows, width, 2 * width)
        add_attention(works, call.batch, call.num_vl_tokens, call.num_vl_tokens, width)
        add_linear(works, "to_out", rows, width, width)
        add_feed_forward(works, rows, width)
    for keys in filter(None, cross_keys(config, call)):
        add_linear(works, "context_to_kv", call.batch * keys, width, 2 * config.width)
    return works


def sample_work(config: HeadConfig, call: Call) -> Works:
    """`ActionHead.sample` on a context, when what depends on the timestep alone is cached.

    The last block computes the action rows only, and so do steps at which the rows of state and future tokens
    are not recomputed.
    """
    width, hidden, horizon = config.width, config.hidden_dim, config.action_horizon
    chunks = call.batch * call.num_samples
    all_rows = config.num_state_rows + call.num_future_tokens + horizon
    works: Works = {}
    state = config.state_history * config.state_dim
    states = call.batch * config.num_state_rows
    add_linear(works, "embodiment", states, state, hidden)
    add_linear(works, "embodiment", states, hidden, width)
    for step in range(call.num_steps):
        running = all_rows if step % call.future_refresh == 0 else horizon
        add_linear(works, "embodiment", chunks * horizon, config.encoder_action_dim, width)
        add_linear(works, "embodiment", chunks * horizon, width, width)
        for block, cross in enumerate(cross_keys(config, call)):
            queries = horizon if block == config.num_layers - 1 else running
            add_linear(works, "to_q", chunks * queries, width, width)
            if cross is None:
                add_linear(works, "to_kv", chunks * running, width, 2 * width)
            add_attention(works, chunks, queries, all_rows if cross is None else cross, width)
            add_linear(works, "to_out", chunks * queries, width, width)
            add_feed_forward(works, chunks * queries, width)
        add_linear(works, "output", chunks * horizon, width, hidden)
        for _, outputs in config.decoders:
            add_linear(works, "embodiment", chunks * horizon, hidden, hidden)
            add_linear(works, "embodiment", chunks * horizon, hidden, outputs)
    return works


def total(works: Works) -> Work:
    """All parts together."""
    return sum(works.values(), Work())


def cross_keys(config: HeadConfig, call: Call) -> Iterator[int | None]:
    """For each block the number of vision-language tokens that it attends to; None for self-attention."""
    every = config.attend_text_every_n_blocks
    for block in range(config.num_layers):
        if config.interleave_self_attention and block % 2 == 1:
            yield None
        elif config.mask_mode == "none":
            yield call.num_vl_tokens
        else:
            yield call.image_tokens if block % (2 * every) else call.num_vl_tokens - call.image_tokens


def add_feed_forward(works: Works, rows: int, width: int) -> None:
    """Adds two layers with a hidden width of `4 * width`."""
    add_linear(works, "feed_forward_in", rows, width, 4 * width)
    add_linear(works, "feed_forward_out", rows, 4 * width, width)


def add_linear(works: Works, part: str, rows: int, in_features: int, out_features: int) -> None:
    """Adds one linear layer over `rows` rows."""
    weights = in_features * out_features
    works[part] = works.get(part, Work()) + Work(rows * weights, weights, rows)


def add_attention(works: Works, sequences: int, queries: int, keys: int, width: int) -> None:
    """Adds scores and weighted sums of values for `sequences` sequences."""
    counted = Work(2 * sequences * queries * keys * width, 2 * sequences * keys * width, sequences * queries)
    works["attention"] = works.get("attention", Work()) + counted
