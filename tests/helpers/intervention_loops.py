"""The torch reference with interventions, written again as loops over rows, keys and heads."""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call, operator, union-attr"

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from saccade import Intervention
from saccade_lab.reference import ActionHead
from saccade_lab.reference.random_weights import random_head, random_inputs
from tests.helpers.reference_cases import small_config

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
