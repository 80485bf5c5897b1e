"""What one run of the torch reference changes and records, block by block.

It is written from the definition of ``Intervention``, independently of the Rust head, so that each tests the
other. Shapes in comments: B is the batch, R the rows, S the vision-language tokens, Q the rows that attend, K
the keys that they attend to: the vision-language tokens in a cross-attention block, the rows in a
self-attention block.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from saccade._internal.arrays import indices, integer
from saccade.errors import InputError
from saccade.head.config import HeadConfig
from saccade.head.intervention import ROW_GROUPS, Chosen, Intervention, Tokens, as_interventions
from saccade.head.trace import check_record
from saccade_lab.reference.checks import check_indices, check_shape
from saccade_lab.reference.masks import Mask, forbidden_tokens, is_cross, removal_bias


@dataclass(frozen=True)
class BlockChange:
    """What one block of one velocity evaluation changes and records. By default nothing.

    Attributes:
        logit_bias: Added to the scaled scores of the attention, broadcast to ``(B, heads, Q, K)``; minus
            infinity removes a key.
        stop_gradient: ``(Q, K)`` bool, True where the reader treats key and value as constants.
        patches: Pairs of row indices ``(n,)`` and new values of these rows after the block, ``(n, width)`` or
            ``(B, n, width)``. Later patches override earlier ones.
        others: Earlier rows that are not recomputed, as self-attention read them last, ``(B, O, width)``.
        hold: Called with the rows as self-attention reads them, ``(B, R, width)``.
        keep_attention: Called with the probabilities ``(B, heads, Q, K)``.
        keep_hidden: Called with the rows after the block and its patches, ``(B, R, width)``.
    """

    logit_bias: Tensor | None = None
    stop_gradient: Tensor | None = None
    patches: Sequence[tuple[Tensor, Tensor]] = ()
    others: Tensor | None = None
    hold: Callable[[Tensor], None] | None = None
    keep_attention: Callable[[Tensor], None] | None = None
    keep_hidden: Callable[[Tensor], None] | None = None

    def all_rows(self, y: Tensor) -> Tensor:
        """The rows that self-attention reads, ``(B, R, width)``, from the computed ``(B, R', width)``."""
        if self.hold is not None:
            self.hold(y)
        return y if self.others is None else torch.cat((self.others, y), dim=1)

    def after(self, rows: Tensor) -> Tensor:
        """Applies the patches to ``rows (B, R, width)``; returns the rows that the next block reads."""
        for index, values in self.patches:
            rows = rows.index_copy(1, index, values.expand(len(rows), -1, -1))
        if self.keep_hidden is not None:
            self.keep_hidden(rows)
        return rows


@dataclass(frozen=True)
class Edit:
    """An ``Intervention`` with normalised fields and with tensors in the dtype of the run.

    Its fields are those of ``Intervention`` except the future tokens.
    """

    cut: tuple[tuple[Chosen, Chosen], ...]
    key_bias: dict[Chosen, Tensor]
    patch: dict[tuple[int, int], dict[Chosen, Tensor]]
    blocks: tuple[int, ...] | None
    steps: tuple[int, ...] | None
    heads: tuple[int, ...] | None

    @classmethod
    def of(cls, one: Any, like: Tensor) -> "Edit":
        """Converts an ``Intervention``."""

        def tensors(arrays: Mapping[Chosen, np.ndarray] | None) -> dict[Chosen, Tensor]:
            found = (arrays or {}).items()
            return {tokens: torch.tensor(a, dtype=like.dtype, device=like.device) for tokens, a in found}

        patch = {place: tensors(rows) for place, rows in (one.patch or {}).items()}
        return cls(one.cut, tensors(one.key_bias), patch, one.blocks, one.steps, one.heads)

    def acts(self, step: int, block: int) -> bool:
        """Whether its limits include this block of this step."""
        return includes(self.blocks, block) and includes(self.steps, step)


def includes(limit: tuple[int, ...] | None, index: int) -> bool:
    """Whether a limit includes this index. None includes all."""
    return limit is None or index in limit


class Run:
    """One run of a head over all of its steps: what is changed, and what is recorded.

    Args:
        config: Config of the head.
        vl_embs: ``(B, S, context_dim)``. The run has its dtype and device.
        num_steps: Number of steps. Default: that of the config.
        in_step: Velocity evaluations in each step.
        future_refresh: The state rows and the future rows are recomputed every ``future_refresh``
            evaluations, starting with the first.
        intervention: One, several or none.
        drop_vl, attention_mask, image_mask: As in ``forbidden_tokens``.
        stop_gradient: Pairs as in ``Intervention.cut``, which apply to the backward pass only.
        record: Any of "attention" and "hidden".
        blocks, steps: What is recorded. Default: all.

    Attributes:
        rows: The slice of each group of rows.
        future_tokens: ``(N', width)``, used in place of the learned ones, or None.
        held: The state rows and the future rows as self-attention last read them, by block.
        attention, hidden: What was recorded so far, by ``(step, block)``.

    Raises:
        InputError, ShapeError, DtypeError: An argument does not fit the head or the inputs.
    """

    def __init__(
        self,
        config: HeadConfig,
        vl_embs: Tensor,
        *,
        num_steps: int | None = None,
        in_step: int = 1,
        future_refresh: int = 1,
        intervention: Intervention | Sequence[Intervention] | None = None,
        drop_vl: Mask = None,
        attention_mask: Mask = None,
        image_mask: Mask = None,
        stop_gradient: Sequence[tuple[Tokens, Tokens]] = (),
        record: Iterable[str] = (),
        blocks: Sequence[int] | int | None = None,
        steps: Sequence[int] | int | None = None,
    ) -> None:
        num_steps = config.num_steps if num_steps is None else integer("num_steps", num_steps)
        if not 1 <= num_steps <= config.num_timestep_buckets:
            raise InputError(f"num_steps: {num_steps}, expected 1 to {config.num_timestep_buckets}")
        check_shape("vl_embs", vl_embs, (None, None, config.context_dim))
        self.config = config
        self.num_steps = num_steps
        self.in_step = in_step
        self.future_refresh = future_refresh
        self.batch, num_vl_tokens, _ = vl_embs.shape
        self.dtype, self.device = vl_embs.dtype, vl_embs.device
        interventions = as_interventions(intervention)
        self.future_tokens = self.replaced_tokens(interventions)
        self.edits = [Edit.of(one, vl_embs) for one in interventions]
        self.stopped = Edit.of(stopped_edges(stop_gradient), vl_embs)
        self.recorded_blocks = indices("blocks", blocks)
        self.recorded_steps = indices("steps", steps)

        num_future = config.num_future_tokens if self.future_tokens is None else len(self.future_tokens)
        self.sizes = {
            "state": config.num_state_rows,
            "future": num_future,
            "action": config.action_horizon,
            "vl": num_vl_tokens,
        }
        ends = np.cumsum([self.sizes[group] for group in ROW_GROUPS]).tolist()
        self.rows = {
            group: slice(end - self.sizes[group], end) for group, end in zip(ROW_GROUPS, ends, strict=True)
        }
        self.num_rows = ends[-1]

        self.forbidden = forbidden_tokens(
            config, vl_embs, drop_vl=drop_vl, attention_mask=attention_mask, image_mask=image_mask
        )
        self.future_bias = self.bias_of_learned_tokens()
        self.keep_attention, self.keep_hidden = check_record(record)
        self.held: dict[int, Tensor] = {}
        self.attention: dict[tuple[int, int], Tensor] = {}
        self.hidden: dict[tuple[int, int], Tensor] = {}
        check_indices("blocks", self.recorded_blocks, config.num_layers)
        check_indices("steps", self.recorded_steps, num_steps)
        for edit in self.edits:
            self.check(edit)
        self.check_edges("stop_gradient", self.stopped)

    def first_row(self, evaluation: int) -> int:
        """The first row that is computed in this evaluation: 0, or the first action row."""
        return 0 if evaluation % self.future_refresh == 0 else self.rows["action"].start

    def hold(self, block: int, y: Tensor) -> None:
        """Keeps the state rows and the future rows of all rows ``(B, R, width)``."""
        self.held[block] = y[:, : self.rows["action"].start]

    def change(self, evaluation: int, block: int) -> BlockChange:
        """What this block changes and records in this evaluation."""
        step = evaluation // self.in_step
        place, cross = (step, block), is_cross(self.config, block)
        first = self.first_row(evaluation)
        holds = not cross and first == 0 and self.future_refresh > 1
        shown = includes(self.recorded_blocks, block) and includes(self.recorded_steps, step)
        attention, hidden = shown and self.keep_attention, shown and self.keep_hidden
        bias = self.logit_bias(step, block, cross)
        return BlockChange(
            logit_bias=None if bias is None else bias[..., -(self.num_rows - first) :, :],
            stop_gradient=self.cut_keys(self.stopped, cross)[first:] if self.stopped.cut else None,
            patches=[(index - first, values) for index, values in self.patches(place)],
            others=None if cross or first == 0 else self.held[block],
            hold=partial(self.hold, block) if holds else None,
            keep_attention=partial(self.attention.__setitem__, place) if attention else None,
            keep_hidden=partial(self.hidden.__setitem__, place) if hidden else None,
        )

    def logit_bias(self, step: int, block: int, cross: bool) -> Tensor | None:
        """The sum of all biases, broadcast to ``(B, heads, Q, K)``; None if there is none."""
        biases = []
        if cross and (forbidden := self.forbidden[block]) is not None:
            biases.append(removal_bias(forbidden, self.dtype))  # (B, 1, 1, S)
        if not cross and self.future_bias is not None:
            biases.append(self.future_bias)  # (1, 1, 1, R)
        for edit in self.edits:
            if not edit.acts(step, block):
                continue
            bias = self.key_bias(edit, cross).masked_fill(self.cut_keys(edit, cross), -torch.inf)
            in_heads = bias.new_zeros(self.config.num_heads, *bias.shape)  # (heads, Q, K)
            in_heads[slice(None) if edit.heads is None else list(edit.heads)] = bias
            if in_heads.any():  # otherwise its keys are in the other kind of block
                biases.append(in_heads[None])  # (1, heads, Q, K)
        return sum(biases[1:], biases[0]) if biases else None

    def key_bias(self, edit: Edit, cross: bool) -> Tensor:
        """The biases on the keys of this kind of block, ``(Q, K)``, equal for every reader."""
        bias = torch.zeros(self.num_keys(cross), dtype=self.dtype, device=self.device)
        for chosen, values in edit.key_bias.items():
            if (chosen[0] == "vl") == cross:
                bias[self.places(chosen)] += values
        return bias.expand(self.num_rows, -1)

    def cut_keys(self, edit: Edit, cross: bool) -> Tensor:
        """The edges that are cut in this kind of block, ``(Q, K)`` bool."""
        hidden = torch.zeros(self.num_rows, self.num_keys(cross), dtype=torch.bool, device=self.device)
        for reader, source in edit.cut:
            if (source[0] == "vl") == cross:
                hidden[self.places(reader)[:, None], self.places(source)] = True
        return hidden

    def patches(self, place: tuple[int, int]) -> list[tuple[Tensor, Tensor]]:
        """``future_key_bias`` on the keys of the rows, ``(1, 1, 1, R)``; zero for other tokens."""
        return [
            (self.places(chosen), values)
            for edit in self.edits
            for chosen, values in edit.patch.get(place, {}).items()
        ]

    def places(self, chosen: Chosen) -> Tensor:
        """Indices of tokens among the rows, or among the vision-language tokens, ``(n,)`` long."""
        group, indices = chosen
        first = 0 if group == "vl" else self.rows[group].start
        numbers = range(self.sizes[group]) if indices is None else indices
        return torch.tensor([first + index for index in numbers], dtype=torch.long, device=self.device)

    def num_keys(self, cross: bool) -> int:
        """K of this kind of block."""
        return self.sizes["vl"] if cross else self.num_rows

    def bias_of_learned_tokens(self) -> Tensor | None:
        """Row indices ``(n,)`` and their new values, ``(n, width)`` or ``(B, n, width)``, in order."""
        if self.config.future_key_bias is None or self.future_tokens is not None:
            return None
        bias = torch.zeros(self.num_rows, dtype=self.dtype, device=self.device)
        bias[self.rows["future"]] = torch.tensor(
            self.config.future_key_bias, dtype=self.dtype, device=self.device
        )
        return bias[None, None, None]

    def replaced_tokens(self, interventions: Sequence[Intervention]) -> Tensor | None:
        """The future tokens of the only intervention that has any, ``(N', width)``, or None.

        Raises:
            InputError: Several interventions have future tokens.
            ShapeError: The tokens have another width than the head.
        """
        given = [one.future_tokens for one in interventions if one.future_tokens is not None]
        if len(given) > 1:
            raise InputError(f"future_tokens: expected in at most one intervention, got {len(given)}")
        if not given:
            return None
        tokens = torch.tensor(given[0], dtype=self.dtype, device=self.device)
        check_shape("future_tokens", tokens, (None, self.config.width))
        return tokens

    def check(self, edit: Edit) -> None:
        """Checks an intervention.

        Raises:
            InputError: It does not fit the sizes of this run, or applies nowhere.
            ShapeError: An array has the wrong shape.
        """
        check_indices("blocks", edit.blocks, self.config.num_layers)
        check_indices("steps", edit.steps, self.num_steps)
        check_indices("heads", edit.heads, self.config.num_heads)
        self.check_edges("cut", edit)
        for reader, source in edit.cut:
            self.some("cut", reader)
            self.some("cut", source)
            self.check_acts(f"cut: {reader[0]} reads {source[0]}", source[0], edit.blocks)
        for chosen, biases in edit.key_bias.items():
            size = self.some("key_bias", chosen)
            self.check_acts(f"key_bias: {chosen[0]} is read", chosen[0], edit.blocks)
            check_shape(f"key_bias: {chosen[0]}", biases, (size,) if biases.ndim == 1 else ())
        for (step, block), groups in edit.patch.items():
            check_indices("patch: step", [step], self.num_steps)
            check_indices("patch: block", [block], self.config.num_layers)
            for chosen, rows in groups.items():
                name = f"patch[({step}, {block})]"
                batch = (self.batch,) if rows.ndim == 3 else ()
                count = self.some(name, chosen)
                check_shape(f"{name}: {chosen[0]}", rows, (*batch, count, self.config.width))
                evaluations = range(step * self.in_step, (step + 1) * self.in_step)
                if chosen[0] != "action" and any(map(self.first_row, evaluations)):
                    raise InputError(
                        f"{name}: expected action tokens, got {chosen[0]} tokens, which are not always "
                        f"computed at step {step} with future_refresh {self.future_refresh}"
                    )

    def check_edges(self, name: str, edit: Edit) -> None:
        """Refuses edges of tokens that do not exist."""
        for pair in edit.cut:
            for chosen in pair:
                self.count(name, chosen)

    def check_acts(self, edge: str, group: str, blocks: tuple[int, ...] | None) -> None:
        """Refuses a cut or bias that has no effect in any of the blocks where it applies.

        Args:
            edge: What is changed, for the message.
            group: The group of the keys.
            blocks: Where it applies.

        Raises:
            InputError: Says in which blocks the keys are read.
        """
        kind = "cross" if group == "vl" else "self"
        existing = [
            block
            for block in range(self.config.num_layers)
            if is_cross(self.config, block) == (group == "vl")
        ]
        if not existing:
            raise InputError(f"{edge} in {kind}-attention blocks only, and this head has none")
        if blocks is not None and not set(blocks) & set(existing):
            raise InputError(
                f"{edge} in {kind}-attention blocks only, which are {existing}; expected blocks with at "
                f"least one of them, got {list(blocks)}"
            )

    def count(self, name: str, chosen: Chosen) -> int:
        """The number of these tokens. Refuses tokens that the group does not have."""
        group, indices = chosen
        check_indices(f"{name}: {group}", indices, self.sizes[group])
        return self.sizes[group] if indices is None else len(indices)

    def some(self, name: str, chosen: Chosen) -> int:
        """The number of these tokens. Refuses an empty choice, and a group without tokens."""
        count = self.count(name, chosen)
        if count > 0:
            return count
        group, indices = chosen
        if indices is None:
            raise InputError(f"{name}: expected tokens, but this call has no {group} tokens")
        raise InputError(f"{name}: expected at least one {group} token, got an empty list")


def stopped_edges(pairs: Sequence[tuple[Tokens, Tokens]]) -> Intervention:
    """Pairs (reader, source) as the normalised cut of an intervention.

    Raises:
        InputError: A pair is not one that ``Intervention.cut`` takes.
    """
    try:
        return Intervention(cut=pairs)
    except InputError as error:
        raise InputError(f"stop_gradient: {error}") from None
