"""Interventions, traces and stopped gradients of the torch reference, against loops over rows and heads."""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call, operator, union-attr"

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch
from reference_cases import small_config
from torch import Tensor

import saccade
from saccade import Intervention
from saccade.reference import ActionHead
from saccade.reference.random_weights import random_head, random_inputs

NUM_VL_TOKENS = 6
EVERY_READER = ("state", "future", "action")


def head_and_inputs(seed: int = 0, *, batch: int = 2, **config: Any) -> tuple[ActionHead, dict[str, Any]]:
    """A head in float64, and the arguments of its `sample`."""
    head = random_head(small_config(**config), seed, dtype=torch.float64)
    inputs: dict[str, Any] = random_inputs(head.config, seed + 1, batch=batch, num_vl_tokens=NUM_VL_TOKENS)
    inputs = {name: t.double() if t.is_floating_point() else t for name, t in inputs.items()}
    with torch.no_grad():
        inputs["vl_embs"] = head.encode(inputs.pop("backbone_features"))
    return head, inputs


def assert_close(given: Tensor, expected: Tensor, tolerance: float = 1e-12) -> None:
    torch.testing.assert_close(given, expected, rtol=tolerance, atol=tolerance)


# The same head, in which every row asks every key whether it sees it

Token = tuple[str, int]


def is_among(token: Token, chosen: Any) -> bool:
    group, indices = chosen
    return token[0] == group and (indices is None or token[1] in indices)


class Loops:
    """One run, number by number. Keeps attention, hidden rows, and all keys and values.

    `frozen` is an earlier run: where an edge of `stopped` is read, its keys and values are used.
    """

    def __init__(
        self,
        head: ActionHead,
        inputs: dict[str, Any],
        interventions: Sequence[Any] = (),
        *,
        num_steps: int = 2,
        drop_vl: np.ndarray | None = None,
        stopped: Sequence[Any] = (),
        frozen: "Loops | None" = None,
    ) -> None:
        self.head, self.interventions, self.drop_vl = head, interventions, drop_vl
        self.stopped, self.frozen = stopped, frozen
        self.attention: dict[tuple[int, int], np.ndarray] = {}
        self.hidden: dict[tuple[int, int], np.ndarray] = {}
        self.keys_values: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
        tokens = head.future_tokens.weight.detach().numpy()
        for one in interventions:
            tokens = tokens if one.future_tokens is None else one.future_tokens.astype(np.float64)
        vl_embs = torch.as_tensor(inputs["vl_embs"])
        horizon = head.config.action_horizon
        self.rows = [("state", 0)]
        self.rows += [("future", index) for index in range(len(tokens))]
        self.rows += [("action", index) for index in range(horizon)]
        self.vl = [("vl", index) for index in range(vl_embs.shape[1])]
        actions = inputs["noise"]
        with torch.no_grad():
            for step in range(num_steps):
                time = torch.full((len(actions),), int(1000 * step / num_steps))
                temb = head.model.timestep_encoder(time)
                ids = inputs["embodiment_id"]
                rows = torch.cat(
                    (
                        head.state_encoder(inputs["state"], ids),
                        torch.as_tensor(tokens).expand(len(actions), -1, -1),
                        head.action_encoder(actions, time, ids) + head.position_embedding.weight[:horizon],
                    ),
                    dim=1,
                )
                for index in range(head.config.num_layers):
                    rows = self.block((step, index), rows, vl_embs, temb)
                decoded = head.action_decoder(head.model.output(rows, temb), ids)
                actions = actions + decoded[:, -horizon:] / num_steps
        self.actions = actions

    def block(self, place: tuple[int, int], rows: Tensor, vl_embs: Tensor, temb: Tensor) -> Tensor:
        block: Any = self.head.model.transformer_blocks[place[1]]
        y = block.norm1(rows, temb)
        source, keys = (vl_embs, self.vl) if place[1] % 2 == 0 else (y, self.rows)
        q, k, v = (
            layer(x).unflatten(-1, (self.head.config.num_heads, -1)).numpy()  # (B, tokens, heads, head_dim)
            for layer, x in ((block.attn1.to_q, y), (block.attn1.to_k, source), (block.attn1.to_v, source))
        )
        self.keys_values[place] = (k, v)
        batch, num_rows, num_heads, head_dim = q.shape
        values = np.zeros(q.shape)
        weights = np.zeros((batch, num_heads, num_rows, len(keys)))
        for b in range(batch):
            for reader, row in enumerate(self.rows):
                for h in range(num_heads):
                    seen = {}
                    for number, key in enumerate(keys):
                        bias = self.bias(place, h, row, key, b)
                        if bias > -math.inf:
                            read_k, read_v = self.read(place, row, key)
                            logit = q[b, reader, h] @ read_k[b, number, h] / math.sqrt(head_dim) + bias
                            seen[number] = (math.exp(logit), read_v[b, number, h])
                    total = sum(weight for weight, _ in seen.values())
                    for number, (weight, value) in seen.items():
                        weights[b, h, reader, number] = weight / total
                        values[b, reader, h] += weight / total * value
        self.attention[place] = weights
        rows = rows + block.attn1.to_out[0](torch.as_tensor(values).flatten(2))
        rows = rows + block.ff(torch.nn.functional.layer_norm(rows, rows.shape[-1:], eps=1e-5))
        patched = rows.numpy().copy()
        for one in self.interventions:
            for (group, indices), new in (one.patch or {}).get(place, {}).items():
                numbers = [n for n, row in enumerate(self.rows) if row[0] == group]
                for position, index in enumerate(range(len(numbers)) if indices is None else indices):
                    patched[:, numbers[index]] = new[..., position, :]
        self.hidden[place] = patched
        return torch.as_tensor(patched)

    def bias(self, place: tuple[int, int], head: int, reader: Token, key: Token, b: int) -> float:
        if self.drop_vl is not None and key[0] == "vl" and self.drop_vl[b, key[1]]:
            return -math.inf
        total = 0.0
        for one in self.interventions:
            here = (one.steps, place[0]), (one.blocks, place[1]), (one.heads, head)
            if any(limits is not None and index not in limits for limits, index in here):
                continue
            if any(is_among(reader, who) and is_among(key, whom) for who, whom in one.cut):
                return -math.inf
            for (group, indices), biases in (one.key_bias or {}).items():
                if is_among(key, (group, indices)):
                    position = key[1] if indices is None else indices.index(key[1])
                    total += float(biases if biases.ndim == 0 else biases[position])
        return total

    def read(self, place: tuple[int, int], reader: Token, key: Token) -> tuple[np.ndarray, np.ndarray]:
        stopped = any(is_among(reader, who) and is_among(key, whom) for who, whom in self.stopped)
        run = self.frozen if stopped and self.frozen is not None else self
        return run.keys_values[place]


def random_interventions(seed: int, *, batch: int, num_steps: int) -> tuple[Intervention, ...]:
    """One to three, with all that they can have, for the head of `small_config` with 4 or else 3 tokens."""
    rng = np.random.default_rng(seed)
    sizes = {"state": 1, "future": 4, "action": 5, "vl": NUM_VL_TOKENS}
    replaced = rng.random() < 0.5
    sizes["future"] = 3 if replaced else 4

    def some(size: int) -> list[int] | None:
        chosen = rng.permutation(size)[: rng.integers(1, size + 1)].tolist()
        return None if rng.random() < 0.3 else chosen

    def tokens(group: str) -> tuple[Any, int]:
        indices = some(sizes[group])
        if indices is None:
            return group, sizes[group]
        return (group, tuple(indices)), len(indices)

    def edge() -> tuple[Any, Any]:
        return tokens(str(rng.choice(EVERY_READER)))[0], tokens(str(rng.choice(list(sizes))))[0]

    def acts(keys: Any, blocks: list[int] | None) -> bool:
        group = keys if isinstance(keys, str) else keys[0]
        return any((block % 2 == 0) == (group == "vl") for block in blocks or range(4))

    made = []
    for number in range(rng.integers(1, 4)):
        blocks = some(4)
        key_bias: dict[Any, Any] = {}
        for group in rng.choice(list(sizes), size=rng.integers(0, 3)):
            chosen, size = tokens(str(group))
            key_bias[chosen] = (
                rng.choice([rng.normal(), -np.inf]) if rng.random() < 0.3 else rng.normal(size=size)
            )
        chosen, size = tokens(str(rng.choice(EVERY_READER)))
        rows = rng.standard_normal((batch, size, 12)[rng.integers(2) :])
        place = (int(rng.integers(num_steps)), int(rng.integers(4)))
        made.append(
            Intervention(
                cut=[pair for pair in (edge() for _ in range(rng.integers(0, 4))) if acts(pair[1], blocks)],
                key_bias={keys: bias for keys, bias in key_bias.items() if acts(keys, blocks)},
                patch={place: {chosen: rows}} if rng.random() < 0.5 else None,
                future_tokens=rng.standard_normal((3, 12)) if replaced and number == 0 else None,
                blocks=blocks,
                steps=some(num_steps),
                heads=some(3),
            )
        )
    return tuple(made)


@pytest.mark.parametrize("seed", range(12))
def test_random_interventions_equal_loops(seed: int) -> None:
    head, inputs = head_and_inputs(seed)
    interventions = random_interventions(seed, batch=2, num_steps=2)
    drop_vl = np.random.default_rng(seed).random((2, NUM_VL_TOKENS)) < 0.3 if seed % 3 == 0 else None
    expected = Loops(head, inputs, interventions, drop_vl=drop_vl)
    options: dict[str, Any] = {"num_steps": 2, "intervention": interventions, "drop_vl": drop_vl}
    with torch.no_grad():
        trace = head.trace(**inputs, **options, record=("attention", "hidden"))
        assert_close(head.sample(**inputs, **options), expected.actions)
    assert_close(trace.actions, expected.actions)
    assert trace.attention.keys() == trace.hidden.keys() == expected.hidden.keys()
    for place, hidden in expected.hidden.items():
        assert_close(trace.hidden[place], torch.as_tensor(hidden))
        attention = torch.as_tensor(expected.attention[place])
        assert_close(trace.attention[place], attention)
        assert ((trace.attention[place] == 0) == (attention == 0)).all()  # removed is exactly zero


# Traces


def test_trace_keeps_what_is_asked_for_where_it_is_asked_for() -> None:
    head, inputs = head_and_inputs()
    everywhere = {(step, block) for step in range(3) for block in range(4)}
    trace = head.trace(**inputs)
    assert trace.attention.keys() == everywhere
    assert trace.hidden == {}
    assert trace.rows == {"state": slice(0, 1), "future": slice(1, 5), "action": slice(5, 10)}
    for (_, block), attention in trace.attention.items():
        assert attention.shape == (2, 3, 10, NUM_VL_TOKENS if block % 2 == 0 else 10)
        assert_close(attention.sum(-1), torch.ones(2, 3, 10).double())
    trace = head.trace(**inputs, record=["hidden"], blocks=[3, 0], steps=1)
    assert trace.hidden.keys() == {(1, 0), (1, 3)}
    assert trace.attention == {}
    assert trace.hidden[1, 3].shape == (2, 10, 12)
    trace = head.trace(**inputs, blocks=range(2), steps=[0])
    assert trace.attention.keys() == {(0, 0), (0, 1)}
    assert head.trace(**inputs, blocks=()).attention == {}


def test_trace_changes_nothing() -> None:
    head, inputs = head_and_inputs()
    expected = head.sample(**inputs)
    assert torch.equal(head.trace(**inputs, record=("hidden",)).actions, expected)
    assert_close(head.trace(**inputs).actions, expected)  # the attention is written out: rounding


def test_rows_of_a_trace_follow_the_future_tokens_given() -> None:
    head, inputs = head_and_inputs()
    seven = Intervention(future_tokens=np.ones((7, 12), np.float32))
    trace = head.trace(**inputs, intervention=seven)
    assert trace.rows == {"state": slice(0, 1), "future": slice(1, 8), "action": slice(8, 13)}
    assert trace.attention[0, 1].shape == (2, 3, 13, 13)


def test_gradients_flow_through_what_was_traced() -> None:
    head, inputs = head_and_inputs(num_layers=2)
    vl_embs = inputs.pop("vl_embs").requires_grad_()

    def traced(vl_embs: Tensor) -> Tensor:
        trace = head.trace(vl_embs, **inputs, num_steps=2, record=("attention", "hidden"))
        return torch.cat([t.flatten() for t in (*trace.attention.values(), *trace.hidden.values())]).sin()

    assert torch.autograd.gradcheck(traced, (vl_embs,), fast_mode=True)
    trace = head.trace(vl_embs, **inputs, record=("attention", "hidden"))
    loss = trace.actions.square().sum()
    kept = [trace.hidden[0, 0], trace.attention[0, 1], head.future_tokens.weight]
    for gradient in torch.autograd.grad(loss, kept):
        assert gradient.isfinite().all()
        assert gradient.any()


# Cuts and patches


def test_a_row_with_no_key_left_gets_the_output_bias_and_finite_gradients() -> None:
    head, inputs = head_and_inputs()
    everyone = Intervention(cut=[(reader, "vl") for reader in EVERY_READER], blocks=0)
    trace = head.trace(**inputs, intervention=everyone, record=("attention", "hidden"))
    assert not trace.attention[0, 0].any()
    assert trace.attention[0, 2].any()
    block: Any = head.model.transformer_blocks[0]
    future = head.future_tokens.weight + block.attn1.to_out[0].bias
    future = future + block.ff(torch.nn.functional.layer_norm(future, (12,), eps=1e-5))
    assert_close(trace.hidden[0, 0][:, trace.rows["future"]], future.expand(2, -1, -1))
    trace.actions.sum().backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in head.parameters())


def test_removing_all_tokens_leaves_the_same() -> None:
    head, inputs = head_and_inputs()
    blind = Intervention(cut=[(reader, "vl") for reader in EVERY_READER])
    with torch.no_grad():
        dropped = head.sample(**inputs, drop_vl=np.ones((2, NUM_VL_TOKENS), bool))
        assert_close(dropped, head.sample(**inputs, intervention=blind))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"cut": [("action", "vl")], "blocks": [1, 3]},
            r"cut: action reads vl in cross-attention blocks only, which are \[0, 2\]; .*got \[1, 3\]",
        ),
        (
            {"cut": [("future", "action")], "blocks": [0, 2]},
            r"cut: future reads action in self-attention blocks only, which are \[1, 3\]",
        ),
        (
            {"cut": [("action", "vl"), ("action", "future")], "blocks": 0},
            "cut: action reads future in self-attention blocks only",
        ),
        ({"key_bias": {"vl": 3.0}, "blocks": [1]}, "key_bias: vl is read in cross-attention blocks only"),
        ({"key_bias": {"state": 3.0}, "blocks": 2}, "key_bias: state is read in self-attention blocks only"),
        ({"cut": [("action", ("vl", ()))]}, "cut: expected at least one vl token, got an empty list"),
    ],
)
def test_what_can_act_nowhere_is_refused(change: dict[str, Any], message: str) -> None:
    head, inputs = head_and_inputs()
    one = Intervention(**change)
    for intervention in (one, [Intervention(), one]):
        with pytest.raises(saccade.InputError, match=message):
            head.sample(**inputs, intervention=intervention)
        with pytest.raises(saccade.InputError, match=message):
            head.trace(**inputs, intervention=intervention)


def test_what_acts_in_some_of_its_blocks_is_fine() -> None:
    head, inputs = head_and_inputs()
    with torch.no_grad():
        some = head.sample(**inputs, intervention=Intervention(cut=[("action", "vl")], blocks=[0, 1, 3]))
        cross = head.sample(**inputs, intervention=Intervention(cut=[("action", "vl")], blocks=[0]))
        assert torch.equal(some, cross)
        assert not torch.equal(some, head.sample(**inputs))
        nothing = [Intervention(), Intervention(key_bias={"future": 0.0})]
        assert torch.equal(head.sample(**inputs, intervention=nothing), head.sample(**inputs))


@pytest.mark.parametrize("name", ["blocks", "steps", "heads"])
@pytest.mark.parametrize("empty", [(), [], range(0), set(), np.empty(0, np.int64)])
def test_empty_limits_are_refused(name: str, empty: Any) -> None:
    with pytest.raises(saccade.InputError, match=f"{name}: expected at least one"):
        Intervention(cut=[("action", "vl")], **{name: empty})


def test_groups_without_tokens_cannot_be_changed() -> None:
    head, inputs = head_and_inputs(num_future_tokens=0)
    for change in (
        Intervention(cut=[("future", "vl")]),
        Intervention(cut=[("action", "future")]),
        Intervention(key_bias={"future": -1.0}),
        Intervention(patch={(0, 0): {"future": np.empty((0, 12), np.float32)}}),
    ):
        with pytest.raises(saccade.InputError, match="this call has no future tokens"):
            head.sample(**inputs, intervention=change)


def test_steps_limit_cuts_and_biases() -> None:
    head, inputs = head_and_inputs()
    later = Intervention(cut=[("action", "vl")], key_bias={"future": 1.0}, steps=[1, 2])
    with torch.no_grad():
        plain = head.trace(**inputs, record=("attention", "hidden"))
        changed = head.trace(**inputs, intervention=later, record=("attention", "hidden"))
    for block in range(4):
        assert_close(changed.hidden[0, block], plain.hidden[0, block])
        assert (changed.hidden[1, block] - plain.hidden[1, block]).abs().max() > 1e-6


def test_patching_a_run_with_its_own_rows_changes_no_bit() -> None:
    head, inputs = head_and_inputs()
    head = head.float()
    inputs = {name: t.float() if t.is_floating_point() else t for name, t in inputs.items()}
    with torch.no_grad():
        trace = head.trace(**inputs, record=("hidden",))
        for place, rows in trace.hidden.items():
            for group in EVERY_READER:
                patch = Intervention(patch={place: {group: rows[:, trace.rows[group]]}})
                assert torch.equal(head.sample(**inputs, intervention=patch), trace.actions)


@pytest.mark.parametrize("block", range(4))
def test_patching_all_rows_reproduces_the_rest_of_the_other_run(block: int) -> None:
    head, inputs = head_and_inputs()
    head = head.float()
    inputs = {name: t.float() if t.is_floating_point() else t for name, t in inputs.items()}
    other = inputs | {"state": -inputs["state"], "noise": inputs["noise"].flip(0)}
    with torch.no_grad():
        mine = head.trace(**inputs, num_steps=1, record=("hidden",))
        patch: Any = {
            (0, block): {group: mine.hidden[0, block][:, where] for group, where in mine.rows.items()}
        }
        patched = head.trace(**other, num_steps=1, record=("hidden",), intervention=Intervention(patch=patch))
    for later in range(block, 4):
        assert torch.equal(patched.hidden[0, later], mine.hidden[0, later])
    velocity = mine.actions - inputs["noise"]
    assert_close(patched.actions - other["noise"], velocity, tolerance=1e-5)  # noise added and taken away


def test_the_last_patch_of_a_row_counts() -> None:
    head, inputs = head_and_inputs()
    first, second = np.zeros((4, 12), np.float32), np.ones((1, 12), np.float32)
    given = (
        Intervention(patch={(0, 1): {"future": first}}),
        Intervention(patch={(0, 1): {("future", 2): second}}),
    )
    expected = [[0.0], [0.0], [1.0], [0.0]]
    rows = head.trace(**inputs, intervention=given, record=("hidden",)).hidden[0, 1][:, 1:5]
    assert torch.equal(rows, torch.tensor(expected).double().expand(2, -1, 12))
    rows = head.trace(**inputs, intervention=given[::-1], record=("hidden",)).hidden[0, 1][:, 1:5]
    assert not rows.any()


def test_velocity_is_step_0_of_1() -> None:
    head, inputs = head_and_inputs()
    noise = inputs.pop("noise")
    one = Intervention(cut=[("action", "vl")], steps=0, patch={(0, 1): {"state": np.ones((1, 12))}})
    with torch.no_grad():
        velocity = head.velocity(**inputs, actions=noise, timestep=0, intervention=one)
        sampled = head.sample(**inputs, noise=noise, num_steps=1, intervention=one)
    assert_close(noise + velocity, sampled)


# Gradients that stop at chosen edges

STOPS: list[list[Any]] = [
    [("state", "future"), ("action", "future")],
    [("future", "vl")],
    [(("action", [1, 3]), ("vl", [0, 2, 5])), ("future", ("action", [0]))],
    [("state", "state"), ("action", "action"), ("action", "vl")],
]


def gradient(head: ActionHead, inputs: dict[str, Any], stop: Any, of: Tensor, **options: Any) -> Tensor:
    actions = head.sample(**inputs, num_steps=2, stop_gradient=stop, **options)
    weights = torch.linspace(-1, 1, actions.numel()).double().view(actions.shape)
    return torch.autograd.grad((weights * actions).sum(), of)[0]


@pytest.mark.parametrize("stop", STOPS)
def test_stopped_edges_are_constants_in_the_gradient(stop: list[Any]) -> None:
    """Finite differences of a run whose stopped edges read the keys and values of a run that is not moved."""
    head, inputs = head_and_inputs()
    interventions = random_interventions(1, batch=2, num_steps=2)
    edges = Intervention(cut=stop).cut
    base = Loops(head, inputs, interventions)
    vl_embs = inputs["vl_embs"].clone().requires_grad_()
    given = gradient(head, inputs | {"vl_embs": vl_embs}, stop, vl_embs, intervention=interventions)
    weights = torch.linspace(-1, 1, base.actions.numel()).double().view(base.actions.shape)
    for seed in range(2):
        generator = torch.Generator().manual_seed(seed)
        direction = torch.randn(vl_embs.shape, generator=generator).double()
        sides = []
        for step in (1e-5, -1e-5):
            moved = inputs | {"vl_embs": inputs["vl_embs"] + step * direction}
            run = Loops(head, moved, interventions, stopped=edges, frozen=base)
            sides.append((weights * run.actions).sum())
        slope = (sides[0] - sides[1]) / 2e-5
        assert_close((given * direction).sum(), slope, tolerance=1e-7)


@pytest.mark.parametrize("stop", STOPS)
def test_stopping_gradients_changes_no_bit_of_the_result(stop: list[Any]) -> None:
    head, inputs = head_and_inputs()
    with torch.no_grad():
        expected = head.trace(**inputs)
        given = head.trace(**inputs, stop_gradient=stop)
        assert torch.equal(given.actions, expected.actions)
        for place, attention in expected.attention.items():
            assert torch.equal(given.attention[place], attention)


def test_no_gradient_is_left_where_all_ways_are_stopped() -> None:
    head, inputs = head_and_inputs()
    vl_embs = inputs["vl_embs"].requires_grad_()
    assert not gradient(head, inputs, [(reader, "vl") for reader in EVERY_READER], vl_embs).any()
    left = gradient(head, inputs, [(reader, ("vl", [0, 4])) for reader in EVERY_READER], vl_embs)
    assert not left[:, [0, 4]].any()
    assert left[:, [1, 2, 3, 5]].any(dim=2).all()
    tokens = head.future_tokens.weight
    assert not gradient(head, inputs, STOPS[0], tokens).any()
    assert gradient(head, inputs, [("action", "future")], tokens).any()  # the way over the state row is open


def test_gradients_by_way_of_entry_add_up() -> None:
    head, inputs = head_and_inputs()
    vl_embs = inputs["vl_embs"].requires_grad_()
    parts = [
        gradient(head, inputs, [(other, "vl") for other in EVERY_READER if other != reader], vl_embs)
        for reader in EVERY_READER
    ]
    assert all(part.any() for part in parts)
    assert_close(sum(parts[1:], parts[0]), gradient(head, inputs, (), vl_embs))


def test_gradient_without_future_rows_is_that_of_a_head_that_reads_constants() -> None:
    """With one step and two blocks the only way over the future rows is one edge, which can be counted."""
    head, inputs = head_and_inputs(num_layers=2)
    vl_embs = inputs["vl_embs"].requires_grad_()
    total = gradient(head, inputs, (), vl_embs)
    direct = gradient(head, inputs, STOPS[0], vl_embs)
    through_future = gradient(head, inputs, [("state", "vl"), ("action", "vl")], vl_embs)
    assert_close(total - direct, through_future)


# What does not fit


@pytest.mark.parametrize(
    ("error", "message", "intervention"),
    [
        (saccade.InputError, "intervention: .*str", "cut"),
        (saccade.InputError, "intervention: ", [Intervention(), None]),
        (saccade.InputError, "blocks: 4, expected 0 to 3", Intervention(blocks=[1, 4])),
        (saccade.InputError, "steps: 3, expected 0 to 2", Intervention(steps=3)),
        (saccade.InputError, "heads: 3, expected 0 to 2", Intervention(heads=range(4))),
        (
            saccade.InputError,
            "cut: future: 4, expected 0 to 3",
            Intervention(cut=[("action", ("future", 4))]),
        ),
        (saccade.InputError, "cut: action: 5, ", Intervention(cut=[(("action", [0, 5]), "vl")])),
        (saccade.InputError, "cut: vl: 6, ", Intervention(cut=[("action", ("vl", 6))])),
        (
            saccade.InputError,
            "key_bias: state: 1, expected 0 to 0",
            Intervention(key_bias={("state", 1): 0.0}),
        ),
        (
            saccade.ShapeError,
            r"key_bias: future: .*\(3,\).*\(4\)",
            Intervention(key_bias={"future": [0.0] * 3}),
        ),
        (saccade.ShapeError, "key_bias: vl: ", Intervention(key_bias={("vl", (1, 2)): [0.0] * 6})),
        (saccade.InputError, "patch: step: 3, ", Intervention(patch={(3, 0): {"state": np.ones((1, 12))}})),
        (saccade.InputError, "patch: block: 4, ", Intervention(patch={(0, 4): {"state": np.ones((1, 12))}})),
        (
            saccade.InputError,
            "future: 4, ",
            Intervention(patch={(0, 0): {("future", 4): np.ones((1, 12))}}),
        ),
        (
            saccade.ShapeError,
            "future: .*expected ",
            Intervention(patch={(0, 0): {"future": np.ones((3, 12))}}),
        ),
        (saccade.ShapeError, "state: .*expected ", Intervention(patch={(0, 0): {"state": np.ones((1, 11))}})),
        (
            saccade.ShapeError,
            "state: .*expected ",
            Intervention(patch={(0, 0): {"state": np.ones((3, 1, 12))}}),
        ),
        (saccade.ShapeError, "future_tokens: ", Intervention(future_tokens=np.ones((4, 11)))),
        (
            saccade.InputError,
            "future_tokens: expected in at most one intervention, got 2",
            [Intervention(future_tokens=np.ones((4, 12)))] * 2,
        ),
        (
            saccade.InputError,
            "cut: future: 2, expected 0 to 1",
            [Intervention(future_tokens=np.ones((2, 12))), Intervention(cut=[("action", ("future", 2))])],
        ),
    ],
)
def test_interventions_that_do_not_fit_are_refused(
    error: type[Exception], message: str, intervention: Any
) -> None:
    head, inputs = head_and_inputs()
    for run in (head.sample, head.trace):
        with pytest.raises(error, match=message):
            run(**inputs, intervention=intervention)


def test_a_head_without_future_tokens_has_none_to_choose() -> None:
    head, inputs = head_and_inputs(num_future_tokens=0)
    with pytest.raises(saccade.InputError, match="cut: future: 0, expected no index"):
        head.sample(**inputs, intervention=Intervention(cut=[("action", ("future", 0))]))


def test_other_arguments_that_do_not_fit_are_refused() -> None:
    head, inputs = head_and_inputs()
    for drop_vl in (np.zeros((2, 5), bool), np.zeros(NUM_VL_TOKENS, bool)):
        with pytest.raises(saccade.ShapeError, match="drop_vl"):
            head.sample(**inputs, drop_vl=drop_vl)
        with pytest.raises(saccade.ShapeError, match="drop_vl"):
            head.encode(inputs["vl_embs"], drop_vl=drop_vl)
    with pytest.raises(saccade.DtypeError, match="drop_vl"):
        head.sample(**inputs, drop_vl=torch.zeros(2, NUM_VL_TOKENS))
    wrong_records: tuple[Any, ...] = ("hidden", ["attention", "rows"], 3)
    for record in wrong_records:
        with pytest.raises(saccade.InputError, match="record"):
            head.trace(**inputs, record=record)
    with pytest.raises(saccade.InputError, match="blocks: 4"):
        head.trace(**inputs, blocks=[4])
    with pytest.raises(saccade.InputError, match="steps: 2"):
        head.trace(**inputs, num_steps=2, steps=[2])
    wrong_stops: tuple[Any, ...] = ("future", [("future",)], [("vl", "future")], [("action", "image")])
    for stop in wrong_stops:
        with pytest.raises(saccade.InputError, match="stop_gradient"):
            head.sample(**inputs, stop_gradient=stop)
    with pytest.raises(saccade.InputError, match="stop_gradient: future: 4"):
        head.sample(**inputs, stop_gradient=[("action", ("future", 4))])
    noise = inputs.pop("noise")
    with pytest.raises(saccade.InputError, match="steps: 1, expected 0 to 0"):
        head.velocity(**inputs, actions=noise, timestep=0, intervention=Intervention(steps=1))
