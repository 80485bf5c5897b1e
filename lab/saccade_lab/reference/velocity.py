"""The network of the GR00T action heads: the velocity of the flow at noisy actions.

Module names follow the checkpoint, so that ``state_dict()`` has the released tensor names. Shapes in
comments: B is the batch, R the rows of the query sequence (H state rows, N future rows, T action rows), S the
vision-language tokens.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from saccade.head.config import HeadConfig
from saccade.head.intervention import Intervention, Tokens
from saccade_lab.reference.checks import as_embodiment, check_shape
from saccade_lab.reference.intervene import Run
from saccade_lab.reference.layers import (
    NORM_EPS,
    ActionEncoder,
    CategoryMlp,
    DiffusionTransformer,
    VlSelfAttention,
    token_table,
)
from saccade_lab.reference.masks import Mask, removal_bias, token_mask
from saccade_lab.reference.state_dropout import STATE_DROPOUT, seen_state
from saccade_lab.reference.training import hold_unused


class VelocityNetwork(nn.Module):
    """The network that ``ActionHead`` samples with and trains.

    It encodes states and noisy actions as rows, which attend to the vision-language tokens and to each other
    in a diffusion transformer, and decodes the action rows to a velocity.

    Args:
        config: Sizes and switches.
        unused: Names of parameters that only the released training uses (``task_log_sigma.NAME``,
            ``mask_token``). They are kept, so that a checkpoint stays complete.
        has_state_dropout: Whether there is ``dropout_prob_by_embodiment``, ``(num_embodiments,)``, zeros at
            first. The states of embodiments with an entry above 0.999 are set to zero.
    """

    mask_token: nn.Parameter  # if it is among `unused`
    dropout_prob_by_embodiment: Tensor  # with `has_state_dropout`

    def __init__(
        self,
        config: HeadConfig,
        *,
        unused: Iterable[str] = (),
        has_state_dropout: bool = False,
    ) -> None:
        super().__init__()
        self.config = config
        categories, hidden, width = config.num_embodiments, config.hidden_dim, config.width
        self.model = DiffusionTransformer(config)
        self.state_encoder = CategoryMlp(categories, config.state_history * config.state_dim, hidden, width)
        self.action_encoder = ActionEncoder(categories, config.encoder_action_dim, width)
        for name, decoded in config.decoders:
            self.add_module(name, CategoryMlp(categories, hidden, hidden, decoded))
        if config.version == "n1.5":  # the released code has the table even if it has no rows
            self.future_tokens = token_table(config.num_future_tokens, width)
        if config.use_vlln:
            self.vlln = nn.LayerNorm(config.context_dim, eps=NORM_EPS)
        if config.vl_num_layers > 0:
            self.vl_self_attention = VlSelfAttention(config)
        if config.add_pos_embed:
            self.position_embedding = token_table(config.max_positions, width)
        for name in unused:
            hold_unused(self, name, config)
        self.drops_states = has_state_dropout
        if has_state_dropout:
            self.register_buffer(STATE_DROPOUT, torch.zeros(config.num_embodiments))

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the parameters, in which everything is computed without autocast."""
        return self.model.proj_out_2.weight.dtype

    @property
    def device(self) -> torch.device:
        """The device of the parameters."""
        return self.model.proj_out_2.weight.device

    @property
    def learned_tokens(self) -> Tensor:
        """The future tokens, ``(N, width)``. Only N1.5 has any."""
        if self.config.version == "n1.5":
            return self.future_tokens.weight
        return torch.empty(0, self.config.width, dtype=self.dtype, device=self.device)

    def encode(self, backbone_features: Tensor | np.ndarray, *, drop_vl: Mask = None) -> Tensor:
        """Computes the vision-language tokens that the blocks attend to, once per observation.

        Every token attends to every other one. The masks of N1.6 and N1.7 apply to the later blocks only.

        Args:
            backbone_features: ``(B, S, context_dim)``.
            drop_vl: Bool ``(B, S)``, True for tokens that are removed, as if they were not in the input.
                Their places remain and are zero, so ``velocity``, ``sample`` and ``trace`` need ``drop_vl``
                as well.

        Returns:
            ``vl_embs (B, S, context_dim)``. These are the features themselves if the head has neither
            ``vlln`` nor VL self-attention.
        """
        features = self.as_input(backbone_features)
        check_shape("backbone_features", features, (None, None, self.config.context_dim))
        removed = token_mask("drop_vl", drop_vl, features)
        if self.config.use_vlln:
            features = self.vlln(features)
        if self.config.vl_num_layers > 0:
            bias = None if removed is None else removal_bias(removed, self.dtype)
            features = self.vl_self_attention(features, bias)
        return features if removed is None else features.masked_fill(removed[..., None], 0.0)

    def velocity(
        self,
        vl_embs: Tensor | np.ndarray,
        state: Tensor | np.ndarray,
        embodiment_id: int | Tensor | np.ndarray,
        actions: Tensor | np.ndarray,
        timestep: int | Tensor | np.ndarray,
        *,
        drop_vl: Mask = None,
        attention_mask: Mask = None,
        image_mask: Mask = None,
        intervention: Intervention | Sequence[Intervention] | None = None,
        stop_gradient: Sequence[tuple[Tokens, Tokens]] = (),
    ) -> Tensor:
        """The velocity of the flow at noisy actions.

        Args:
            vl_embs: ``(B, S, context_dim)``, from ``encode``.
            state: ``(B, num_states, state_dim)``, or ``(B, state_dim)`` for one state; normalised and padded.
            embodiment_id: An int, or ``(B,)``.
            actions: ``(B, T, encoder_action_dim)``.
            timestep: Time bucket, an int or ``(B,)``.
            drop_vl, attention_mask, image_mask, intervention, stop_gradient: As in ``ActionHead.trace``.
                This evaluation is step 0 of 1.

        Returns:
            ``(B, T, action_dim)``.

        Raises:
            ShapeError: An array has the wrong shape.
            InputError: The head does not have the embodiment, or a place of an intervention.
        """
        vl_embs = self.as_input(vl_embs)
        run = Run(
            self.config,
            vl_embs,
            num_steps=1,
            drop_vl=drop_vl,
            attention_mask=attention_mask,
            image_mask=image_mask,
            intervention=intervention,
            stop_gradient=stop_gradient,
        )
        return self.velocity_in(run, 0, vl_embs, state, embodiment_id, actions, timestep)

    def velocity_in(
        self,
        run: Run,
        evaluation: int,
        vl_embs: Tensor,
        state: Tensor | np.ndarray,
        embodiment_id: int | Tensor | np.ndarray,
        actions: Tensor | np.ndarray,
        timestep: int | Tensor | np.ndarray,
    ) -> Tensor:
        """One velocity evaluation of a run. Arguments, result and errors are as in ``velocity``."""
        config, horizon = self.config, self.config.action_horizon
        actions, state = self.as_input(actions), self.as_input(state)
        batch = vl_embs.shape[0]
        check_shape("actions", actions, (batch, horizon, config.encoder_action_dim))
        state = state[:, None] if state.ndim == 2 else state
        check_shape("state", state, (batch, config.num_states, config.state_dim))
        state = state.reshape(batch, config.num_state_rows, -1)  # (B, H, state_history * state_dim)
        embodiment_id = as_embodiment(embodiment_id, batch, config.num_embodiments, self.device)
        timestep = torch.as_tensor(timestep, device=self.device).expand(batch)  # (B,)
        if self.drops_states:
            state = seen_state(state, self.dropout_prob_by_embodiment, embodiment_id)

        state_rows = self.state_encoder(state, embodiment_id)  # (B, H, width)
        tokens = self.learned_tokens if run.future_tokens is None else run.future_tokens  # (N, width)
        future_rows = tokens.expand(batch, -1, -1)  # (B, N, width)
        action_rows = self.action_encoder(actions, timestep, embodiment_id)  # (B, T, width)
        if config.add_pos_embed:
            action_rows = action_rows + self.position_embedding.weight[:horizon]
        rows = torch.cat((state_rows, future_rows, action_rows), dim=1)  # (B, R, width)

        changes = [run.change(evaluation, block) for block in range(config.num_layers)]
        hidden = self.model(rows[:, run.first_row(evaluation) :], vl_embs, timestep, changes)[
            :, -horizon:
        ]  # (B, T, hidden_dim)
        decoded = [self.get_submodule(name)(hidden, embodiment_id) for name, _ in config.decoders]
        return torch.cat(decoded, dim=-1)  # (B, T, action_dim)

    def as_input(self, array: Tensor | np.ndarray) -> Tensor:
        """The array as a tensor in the dtype and on the device of the head."""
        if isinstance(array, Tensor):
            return array.to(dtype=self.dtype, device=self.device)
        return torch.tensor(array, dtype=self.dtype, device=self.device)  # copies: the array may be read-only
