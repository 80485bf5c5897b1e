"""What is changed and what is kept in one run of the torch reference, block by block.

Written from the definition of `Intervention`, apart from the Rust head, so that each can check the other.
Shapes in comments as in `model.py`; Q are the rows that read, K the keys they read: the vision-language
tokens in a cross-attention block, the rows themselves in a self-attention block.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from saccade._arrays import boolean, indices
from saccade.config import HeadConfig
from saccade.errors import InputError
from saccade.intervention import ROW_GROUPS, Chosen, Intervention, Tokens, as_interventions
from saccade.reference.checks import check_indices, check_shape
from saccade.trace import check_record

Mask: TypeAlias = "Tensor | np.ndarray | None"


@dataclass(frozen=True)
class BlockChange:
    """What one block of one Euler step does differently, and who is shown what; by default nothing, nobody.

    Attributes:
        logit_bias: added to the attention's scaled scores, broadcast to `(B, heads, Q, K)`; minus infinity
            removes a key.
        stop_gradient: `(Q, K)` bool, True where the reader takes key and value as constants.
        patches: pairs of row indices `(n,)` and what replaces these rows after the block, `(n, width)` or
            `(B, n, width)`; the last one counts.
        others: rows as self-attention read them before, where only the rows after these run;
            `(B, O, width)`.
        hold: is given the rows as self-attention reads them, `(B, R, width)`.
        keep_attention: is given the probabilities `(B, heads, Q, K)`.
        keep_hidden: is given the rows after the block and its patches, `(B, R, width)`.
    """

    logit_bias: Tensor | None = None
    stop_gradient: Tensor | None = None
    patches: Sequence[tuple[Tensor, Tensor]] = ()
    others: Tensor | None = None
    hold: Callable[[Tensor], None] | None = None
    keep_attention: Callable[[Tensor], None] | None = None
    keep_hidden: Callable[[Tensor], None] | None = None

    def all_rows(self, y: Tensor) -> Tensor:
        """What self-attention reads where the rows `y (B, R', width)` run: `(B, R, width)`."""
        if self.hold is not None:
            self.hold(y)
        return y if self.others is None else torch.cat((self.others, y), dim=1)

    def after(self, rows: Tensor) -> Tensor:
        """The rows that the next block reads: `(B, R, width)` to the same shape."""
        for index, values in self.patches:
            rows = rows.index_copy(1, index, values.expand(len(rows), -1, -1))
        if self.keep_hidden is not None:
            self.keep_hidden(rows)
        return rows


@dataclass(frozen=True)
class Edit:
    """An `Intervention` in the types of its normal form, with tensors in the run's dtype.

    Its fields are those of `Intervention`, without the future tokens.
    """

    cut: tuple[tuple[Chosen, Chosen], ...]
    key_bias: dict[Chosen, Tensor]
    patch: dict[tuple[int, int], dict[Chosen, Tensor]]
    blocks: tuple[int, ...] | None
    steps: tuple[int, ...] | None
    heads: tuple[int, ...] | None

    @classmethod
    def of(cls, one: Any, like: Tensor) -> "Edit":
        """Reads an `Intervention`, whose fields are declared as all that may be given."""

        def tensors(arrays: Mapping[Chosen, np.ndarray] | None) -> dict[Chosen, Tensor]:
            found = (arrays or {}).items()
            return {tokens: torch.tensor(a, dtype=like.dtype, device=like.device) for tokens, a in found}

        patch = {place: tensors(rows) for place, rows in (one.patch or {}).items()}
        return cls(one.cut, tensors(one.key_bias), patch, one.blocks, one.steps, one.heads)

    def acts(self, step: int, block: int) -> bool:
        """Whether its limits include this block of this Euler step."""
        return includes(self.blocks, block) and includes(self.steps, step)


def includes(limit: tuple[int, ...] | None, index: int) -> bool:
    """Whether a limit includes this index. None includes all."""
    return limit is None or index in limit


class Run:
    """One run of a head, over all of its Euler steps: what is changed, and what is kept.

    Args:
        config: the head's.
        vl_embs: `(B, S, context_dim)`; its dtype and device are those of the run.
        num_steps: Euler steps.
        in_step: evaluations of the velocity in each step.
        future_refresh: the rows of state and future tokens run at every so many evaluations, from the first
            one on.
        intervention: one, several or none.
        drop_vl, attention_mask, image_mask: as in `forbidden_tokens`.
        stop_gradient: pairs as in `Intervention.cut`, cut in the backward pass only.
        record: any of "attention" and "hidden".
        blocks, steps: where it is recorded; default everywhere.

    Attributes:
        rows: where each group of rows lies.
        future_tokens: `(N', width)` to use in place of the learned ones, or None.
        held: what self-attention last read of the rows of state and future tokens, by block.
        attention, hidden: what was kept so far, by `(step, block)`.

    Raises:
        InputError, ShapeError, DtypeError: an argument does not fit the head or the inputs.
    """

    def __init__(
        self,
        config: HeadConfig,
        vl_embs: Tensor,
        *,
        num_steps: int,
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
            "state": 1,
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
        """The first row that runs at this evaluation of the velocity: 0, or the first of the actions."""
        return 0 if evaluation % self.future_refresh == 0 else self.rows["action"].start

    def hold(self, block: int, y: Tensor) -> None:
        """Holds the rows of state and future tokens, of all rows `(B, R, width)`."""
        self.held[block] = y[:, : self.rows["action"].start]

    def change(self, evaluation: int, block: int) -> BlockChange:
        """What happens in this block of this evaluation of the velocity, to the rows that run."""
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
        """The sum of all biases, broadcast to `(B, heads, Q, K)`; None where there is none."""
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
            if in_heads.any():  # else its keys are in the other kind of block
                biases.append(in_heads[None])  # (1, heads, Q, K)
        return sum(biases[1:], biases[0]) if biases else None

    def key_bias(self, edit: Edit, cross: bool) -> Tensor:
        """The biases on the keys of such a block, `(Q, K)`, the same for every reader."""
        bias = torch.zeros(self.num_keys(cross), dtype=self.dtype, device=self.device)
        for chosen, values in edit.key_bias.items():
            if (chosen[0] == "vl") == cross:
                bias[self.places(chosen)] += values
        return bias.expand(self.num_rows, -1)

    def cut_keys(self, edit: Edit, cross: bool) -> Tensor:
        """Which row reads which key of such a block no longer, `(Q, K)` bool."""
        hidden = torch.zeros(self.num_rows, self.num_keys(cross), dtype=torch.bool, device=self.device)
        for reader, source in edit.cut:
            if (source[0] == "vl") == cross:
                hidden[self.places(reader)[:, None], self.places(source)] = True
        return hidden

    def patches(self, place: tuple[int, int]) -> list[tuple[Tensor, Tensor]]:
        """Row indices `(n,)` and their new values, `(n, width)` or `(B, n, width)`, in the order given."""
        return [
            (self.places(chosen), values)
            for edit in self.edits
            for chosen, values in edit.patch.get(place, {}).items()
        ]

    def places(self, chosen: Chosen) -> Tensor:
        """Where these tokens lie among the rows, or among the vision-language tokens; `(n,)` long."""
        group, indices = chosen
        first = 0 if group == "vl" else self.rows[group].start
        numbers = range(self.sizes[group]) if indices is None else indices
        return torch.tensor([first + index for index in numbers], dtype=torch.long, device=self.device)

    def num_keys(self, cross: bool) -> int:
        """K of such a block."""
        return self.sizes["vl"] if cross else self.num_rows

    def bias_of_learned_tokens(self) -> Tensor | None:
        """`future_key_bias` on the keys of the rows, `(1, 1, 1, R)`; other tokens come without it."""
        if self.config.future_key_bias is None or self.future_tokens is not None:
            return None
        bias = torch.zeros(self.num_rows, dtype=self.dtype, device=self.device)
        bias[self.rows["future"]] = torch.tensor(
            self.config.future_key_bias, dtype=self.dtype, device=self.device
        )
        return bias[None, None, None]

    def replaced_tokens(self, interventions: Sequence[Intervention]) -> Tensor | None:
        """The future tokens of the one intervention that has some, `(N', width)`."""
        given = [one.future_tokens for one in interventions if one.future_tokens is not None]
        if len(given) > 1:
            raise InputError(f"future_tokens: in {len(given)} interventions, expected in at most one")
        if not given:
            return None
        tokens = torch.tensor(given[0], dtype=self.dtype, device=self.device)
        check_shape("future_tokens", tokens, (None, self.config.width))
        return tokens

    def check(self, edit: Edit) -> None:
        """Refuses what the sizes of this run do not have."""
        check_indices("blocks", edit.blocks, self.config.num_layers)
        check_indices("steps", edit.steps, self.num_steps)
        check_indices("heads", edit.heads, self.config.num_heads)
        self.check_edges("cut", edit)
        for chosen, biases in edit.key_bias.items():
            size = self.count("key_bias", chosen)
            check_shape(f"key_bias: {chosen[0]}", biases, (size,) if biases.ndim == 1 else ())
        self.check_effect(edit)
        for (step, block), groups in edit.patch.items():
            check_indices("patch: step", [step], self.num_steps)
            check_indices("patch: block", [block], self.config.num_layers)
            for chosen, rows in groups.items():
                name = f"patch[({step}, {block})]"
                batch = (self.batch,) if rows.ndim == 3 else ()
                count = self.count(name, chosen)
                check_shape(f"{name}: {chosen[0]}", rows, (*batch, count, self.config.width))
                evaluations = range(step * self.in_step, (step + 1) * self.in_step)
                if count and chosen[0] != "action" and any(map(self.first_row, evaluations)):
                    raise InputError(
                        f"{name}: {chosen[0]} tokens, expected action tokens, since with future_refresh "
                        f"{self.future_refresh} the others do not always run at step {step}"
                    )

    def check_edges(self, name: str, edit: Edit) -> None:
        """Refuses tokens that are not there."""
        for pair in edit.cut:
            for chosen in pair:
                self.count(name, chosen)

    def check_effect(self, edit: Edit) -> None:
        """Refuses cuts and biases none of which exists in any of the blocks where they apply.

        Raises:
            InputError: Says in which blocks the edges exist.
        """
        edges = [(f"cut of {source[0]} keys", source[0]) for _, source in edit.cut]
        edges += [(f"key_bias on {chosen[0]} keys", chosen[0]) for chosen in edit.key_bias]
        blocks = range(self.config.num_layers) if edit.blocks is None else edit.blocks
        kinds = {is_cross(self.config, block) for block in blocks}
        if not edges or any((group == "vl") in kinds for _, group in edges):
            return
        what, group = edges[0]
        existing = [b for b in range(self.config.num_layers) if is_cross(self.config, b) == (group == "vl")]
        kind = "cross-attention" if group == "vl" else "self-attention"
        where = ", ".join(map(str, existing)) or "none in this head"
        raise InputError(
            f"intervention: a {what} has no effect in blocks {', '.join(map(str, blocks))}: these keys exist "
            f"in {kind} blocks only ({where})"
        )

    def count(self, name: str, chosen: Chosen) -> int:
        """How many tokens these are; refuses those that the group does not have."""
        group, indices = chosen
        check_indices(f"{name}: {group}", indices, self.sizes[group])
        return self.sizes[group] if indices is None else len(indices)


def is_cross(config: HeadConfig, block: int) -> bool:
    """Whether this block reads the vision-language tokens; the others read the rows themselves."""
    return block % 2 == 0 or not config.interleave_self_attention


def stopped_edges(pairs: Sequence[tuple[Tokens, Tokens]]) -> Intervention:
    """Pairs (reader, source) in the normal form of a cut."""
    try:
        return Intervention(cut=pairs)
    except InputError as error:
        raise InputError(f"stop_gradient: {error}") from None


def reads_images(config: HeadConfig, block: int) -> bool:
    """Whether this cross-attention block of a head with alternate masks reads the image tokens; the others
    read the rest."""
    return block % (2 * config.attend_text_every_n_blocks) != 0


def forbidden_tokens(
    config: HeadConfig, tokens: Tensor, *, drop_vl: Mask, attention_mask: Mask, image_mask: Mask
) -> list[Tensor | None]:
    """Which vision-language tokens no row reads, block by block.

    Args:
        config: the head's.
        tokens: `(B, S, context_dim)`.
        drop_vl: bool `(B, S)`, True where a token is removed.
        attention_mask: bool `(B, S)`, True where a token is attended; None for all of them.
        image_mask: bool `(B, S)`, True where a token is of an image; asked for with alternate masks.

    Returns:
        For every block bool `(B, S)`, or None where all are read.

    Raises:
        DtypeError, ShapeError: a mask of another dtype or shape.
        InputError: padding for a head that ignores it; a mask missing; an observation in which a block has
            nothing left to read.
    """
    removed = token_mask("drop_vl", drop_vl, tokens)
    attended = token_mask("attention_mask", attention_mask, tokens)
    image = token_mask("image_mask", image_mask, tokens)
    if config.mask_mode == "none":
        if attended is not None and not attended.all():
            raise InputError(
                "attention_mask: a false entry, expected all true: this head ignores padding, as released "
                "(None); drop_vl removes tokens"
            )
        return [removed] * config.num_layers
    if image is None:
        raise InputError(
            "image_mask: None, expected bool (batch, T_vl): blocks of this head read either text or images"
        )
    permitted = torch.ones_like(image) if attended is None else attended
    if removed is not None:
        permitted = permitted & ~removed
    forbidden: list[Tensor | None] = []
    for block in range(config.num_layers):
        if not is_cross(config, block):
            forbidden.append(None)
            continue
        kind, chosen = ("image", image) if reads_images(config, block) else ("text", ~image)
        read = permitted & chosen  # (B, S)
        if not read.any(dim=1).all():
            row = int(read.any(dim=1).int().argmin())
            raise InputError(
                f"image_mask: observation {row} has no {kind} token left for block {block} to read"
            )
        forbidden.append(~read)
    return forbidden


def token_mask(name: str, given: Mask, tokens: Tensor) -> Tensor | None:
    """A mask as a bool tensor `(B, S)` for `tokens (B, S, context_dim)`, or None.

    Raises:
        DtypeError: it is not boolean.
        ShapeError: it is of another shape.
    """
    array = boolean(name, given)
    if array is None:
        return None
    mask = torch.tensor(array, device=tokens.device)
    check_shape(name, mask, tuple(tokens.shape[:2]))
    return mask


def removal_bias(removed: Tensor, dtype: torch.dtype) -> Tensor:
    """Minus infinity on the keys that are removed: `(B, S)` bool to `(B, 1, 1, S)`."""
    bias = torch.zeros(removed.shape, dtype=dtype, device=removed.device).masked_fill(removed, -torch.inf)
    return bias[:, None, None]
