"""The GR00T action heads as one torch module: N1, N1.5, N1.6, N1.7 and a fork.

They are one architecture with different sizes and switches. ``velocity`` has the network. Here are the
sampler, which follows its velocity from noise to actions, and the loss. Shapes in comments: B is the batch, T
the actions of a chunk, S the vision-language tokens.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from saccade._internal.arrays import integer
from saccade._internal.hub import resolve
from saccade._internal.hub_files import HEAD
from saccade.errors import InputError
from saccade.head.chunking import Chunking
from saccade.head.config import HeadConfig
from saccade.head.intervention import Intervention, Tokens
from saccade.head.options import INTEGRATORS, check_integrator
from saccade.head.trace import Trace
from saccade_lab.reference import loading
from saccade_lab.reference.checks import check_shape
from saccade_lab.reference.chunking import start_of
from saccade_lab.reference.guidance import Guidance
from saccade_lab.reference.intervene import Run
from saccade_lab.reference.masks import Mask
from saccade_lab.reference.state_dropout import STATE_DROPOUT, check_probabilities, drops_states
from saccade_lab.reference.training import TimeDistribution, flow_matching_error, is_unused
from saccade_lab.reference.velocity import VelocityNetwork


class ActionHead(VelocityNetwork):
    """A GR00T action head in torch.

    The head computes in the dtype of its parameters (``.double()`` for float64) and is differentiable. Inputs
    may be NumPy arrays and are converted to that dtype. Wrap calls in ``torch.no_grad()`` if no gradient is
    needed. A new head has the initial distribution of the released code. Unlike the released training, there
    is no dropout, and states are not made noisy, nor dropped except by ``dropout_prob_by_embodiment``.

    Args:
        config: Sizes and switches.
        time_distribution: The distribution of ``sample_time``.
        unused, has_state_dropout: As in ``VelocityNetwork``.

    Example:
        >>> from saccade_lab.reference import random_weights
        >>> head = random_weights.random_head(random_weights.small_config(), seed=0, dtype=torch.float64)
        >>> inputs = random_weights.random_inputs(head.config, seed=1, batch=2, num_vl_tokens=7)
        >>> vl_embs = head.encode(inputs["backbone_features"])
        >>> head.sample(vl_embs, inputs["state"], 2, noise=inputs["noise"]).shape
        torch.Size([2, 16, 32])

        How much the action rows attend to each of the 32 future rows in block 1 of the first Euler step:

        >>> trace = head.trace(vl_embs, inputs["state"], 2, noise=inputs["noise"])
        >>> trace.attention[0, 1][:, :, trace.rows["action"], trace.rows["future"]].shape
        torch.Size([2, 2, 16, 32])
    """

    def __init__(
        self,
        config: HeadConfig,
        *,
        time_distribution: TimeDistribution | None = None,
        unused: Iterable[str] = (),
        has_state_dropout: bool = False,
    ) -> None:
        super().__init__(config, unused=unused, has_state_dropout=has_state_dropout)
        self.time_distribution = time_distribution or TimeDistribution()

    @classmethod
    def from_pretrained(
        cls,
        id_or_path: str | PathLike[str],
        *,
        revision: str | None = None,
        config: Mapping[str, Any] | str | PathLike[str] | None = None,
        action_horizon: int | None = None,
        num_states: int | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> ActionHead:
        """Loads the head from a checkpoint.

        Args:
            id_or_path: A directory or a file in any layout that
                :meth:`saccade.ActionHead.from_pretrained` reads, or the id of a published checkpoint.
            revision: A branch, tag or commit of the id. Default: ``main``.
            config: The config of the checkpoint or of the head, as a dict or a path. Default: the
                ``config.json`` in the same directory, or else the ``config`` entry in the metadata of a
                single file.
            action_horizon, num_states: As for :meth:`saccade.ActionHead.from_pretrained`.
            dtype: Dtype of the parameters. Narrower stored dtypes are widened, which is exact.

        Raises:
            FileNotFoundError: A path or id does not exist, or cannot be downloaded.
            PermissionError: The Hub denies access to the id.
            CheckpointError: There is no config, or tensors are missing, unknown or of the wrong shape. The
                message lists all of them.
            InputError: ``action_horizon`` or ``num_states`` is out of range.
        """
        checkpoint = loading.described(resolve(id_or_path, revision, files=HEAD), config)
        whole, names = checkpoint.head_config, loading.tensor_names(checkpoint)
        has_state_dropout = STATE_DROPOUT in names
        drops = drops_states(whole, has_state_dropout)
        sizes = HeadConfig.from_dict(whole, num_states=num_states)
        if action_horizon is not None:
            sizes = replace(sizes, action_horizon=integer("action_horizon", action_horizon))
            if sizes.add_pos_embed and sizes.action_horizon > sizes.max_positions:
                raise InputError(f"action_horizon: expected 1 to {sizes.max_positions}, got {action_horizon}")
        with torch.device("meta"):  # no memory and no time for an initialisation that is replaced
            head = cls(
                sizes,
                time_distribution=TimeDistribution.from_dict(whole),
                unused=filter(is_unused, names),
                has_state_dropout=has_state_dropout,
            )
        shapes = {name: tensor.shape for name, tensor in head.state_dict().items()}
        head.load_state_dict(loading.read_tensors(checkpoint, shapes, dtype), assign=True)
        head.drops_states = drops
        if drops:
            check_probabilities(head.dropout_prob_by_embodiment)
        return head

    def sample(
        self,
        vl_embs: Tensor | np.ndarray,
        state: Tensor | np.ndarray,
        embodiment_id: int | Tensor | np.ndarray,
        *,
        noise: Tensor | np.ndarray,
        num_steps: int | None = None,
        integrator: str | None = None,
        future_refresh: int | None = None,
        previous_chunk: Tensor | np.ndarray | None = None,
        chunking: Chunking | None = None,
        guidance: Guidance | None = None,
        drop_vl: Mask = None,
        attention_mask: Mask = None,
        image_mask: Mask = None,
        intervention: Intervention | Sequence[Intervention] | None = None,
        stop_gradient: Sequence[tuple[Tokens, Tokens]] = (),
    ) -> Tensor:
        """Follows the flow from noise (time 0) to actions (time 1) in equal steps.

        Args:
            vl_embs, state, embodiment_id: As in ``velocity``.
            noise: ``(B, T, encoder_action_dim)``, standard normal.
            num_steps: Number of steps. Default: that of the config.
            integrator: "euler" (default), or "midpoint", which evaluates the velocity twice in each step.
            future_refresh: The state rows and the future rows are recomputed every ``future_refresh``
                velocity evaluations, starting with the first. At the others, self-attention reads them as
                they were. Default: at every evaluation.
            previous_chunk: The chunk that the robot is executing, ``(B, rows, action_dim)`` or
                ``(B, rows, encoder_action_dim)``, normalised, with at least ``chunking.horizon`` rows.
                Required with ``chunking``.
            chunking: How this chunk continues the previous one. ``velocity_strength`` is the factor of the
                velocity, in both evaluations of a midpoint step.
            guidance: A second context and a weight w: the velocity is u + w (v - u), where u is that of the
                second context, at every evaluation.
            drop_vl, attention_mask, image_mask, intervention, stop_gradient: As in ``trace``. All evaluations
                of a step belong to that step. A patch of rows at a step where they are not always computed is
                an error.

        Returns:
            Actions ``(B, T, action_dim)``, normalised.

        Raises:
            ShapeError, DtypeError: An array does not fit.
            InputError: A value is out of range, or an intervention does not fit the head.
        """
        vl_embs = self.as_input(vl_embs)
        run_of = functools.partial(
            Run,
            self.config,
            num_steps=num_steps,
            in_step=INTEGRATORS[check_integrator(integrator)],
            future_refresh=1 if future_refresh is None else integer("future_refresh", future_refresh),
            intervention=intervention,
            stop_gradient=stop_gradient,
        )
        run = run_of(vl_embs, drop_vl=drop_vl, attention_mask=attention_mask, image_mask=image_mask)
        second = None
        if guidance is not None:
            embs = self.as_input(guidance.vl_embs)
            masks = {name: getattr(guidance, name) for name in ("drop_vl", "attention_mask", "image_mask")}
            second = (guidance.weight, run_of(embs, **masks), embs)
        previous = None if previous_chunk is None else self.as_input(previous_chunk)
        start, strength = start_of(self.as_input(noise), previous, chunking, self.config)
        return self.follow(run, vl_embs, state, embodiment_id, start, strength, second)

    def trace(
        self,
        vl_embs: Tensor | np.ndarray,
        state: Tensor | np.ndarray,
        embodiment_id: int | Tensor | np.ndarray,
        *,
        noise: Tensor | np.ndarray,
        num_steps: int | None = None,
        drop_vl: Mask = None,
        attention_mask: Mask = None,
        image_mask: Mask = None,
        intervention: Intervention | Sequence[Intervention] | None = None,
        stop_gradient: Sequence[tuple[Tokens, Tokens]] = (),
        record: Iterable[str] = ("attention",),
        blocks: Sequence[int] | int | None = None,
        steps: Sequence[int] | int | None = None,
    ) -> Trace[Tensor]:
        """Samples as ``sample`` does, and records attention and hidden states, which are part of the graph.

        The gradient with stopped edges is the sum over all paths from the result back to an input that use
        none of these edges. With ``[("state", "future"), ("action", "future")]``, it is the part that does
        not pass through future rows. The total gradient minus this is the part that does.

        Args:
            vl_embs, state, embodiment_id, noise, num_steps: As in ``sample``.
            drop_vl: Bool ``(B, S)``, as given to ``encode``: no row attends to these tokens.
            attention_mask: Bool ``(B, S)``, True where a token is attended. Default: everywhere. A head that
                ignores padding accepts an all-true mask only.
            image_mask: Bool ``(B, S)``, True for image tokens. Required for N1.6 and N1.7, whose
                cross-attention blocks attend to text and images in turn.
            intervention: One or several :class:`saccade.Intervention`.
            stop_gradient: Pairs (reader, source) as in ``Intervention.cut``, in all blocks, steps and heads.
                The result is unchanged up to rounding, but in the backward pass the rows of the reader treat
                the keys and values of the source as constants.
            record: What is recorded, any of "attention" and "hidden".
            blocks: The blocks that are recorded. Default: all.
            steps: The steps that are recorded. Default: all.

        Returns:
            Attention probabilities, rows after the blocks, and the actions of ``sample`` up to rounding.

        Raises:
            ShapeError, DtypeError: An array does not fit.
            InputError: A value is out of range, or an intervention does not fit the head.
        """
        vl_embs = self.as_input(vl_embs)
        run = Run(
            self.config,
            vl_embs,
            num_steps=num_steps,
            intervention=intervention,
            drop_vl=drop_vl,
            attention_mask=attention_mask,
            image_mask=image_mask,
            stop_gradient=stop_gradient,
            record=record,
            blocks=blocks,
            steps=steps,
        )
        actions = self.follow(run, vl_embs, state, embodiment_id, self.as_input(noise))
        return Trace(attention=run.attention, hidden=run.hidden, rows=run.rows, actions=actions)

    def follow(
        self,
        run: Run,
        vl_embs: Tensor,
        state: Tensor | np.ndarray,
        embodiment_id: int | Tensor | np.ndarray,
        start: Tensor,
        strength: Tensor | None = None,
        second: tuple[float, Run, Tensor] | None = None,
    ) -> Tensor:
        """The steps of ``sample`` from ``start (B, T, encoder_action_dim)`` to ``(B, T, action_dim)``.

        ``strength (T, 1)`` multiplies the velocity. ``second`` is the weight of a guidance, and the run and
        the tokens of its context. If the head decodes fewer dimensions than it encodes, the others are kept
        at 0.
        """
        config = self.config
        check_shape("noise", start, (len(vl_embs), config.action_horizon, config.encoder_action_dim))
        rest = (0, config.encoder_action_dim - config.action_dim)

        def velocity(evaluation: int, actions: Tensor) -> Tensor:
            time = evaluation / (run.num_steps * run.in_step)
            bucket = int(time * config.num_timestep_buckets)
            direction = self.velocity_in(run, evaluation, vl_embs, state, embodiment_id, actions, bucket)
            if second is not None:
                weight, other, embs = second
                away = self.velocity_in(other, evaluation, embs, state, embodiment_id, actions, bucket)
                direction = away + weight * (direction - away)
            return F.pad(direction if strength is None else strength * direction, rest)

        actions = F.pad(start[..., : config.action_dim], rest)
        for step in range(run.num_steps):
            direction = velocity(step * run.in_step, actions)
            if run.in_step == 2:  # the midpoint rule
                direction = velocity(2 * step + 1, actions + direction / (2 * run.num_steps))
            actions = actions + direction / run.num_steps
        return actions[..., : config.action_dim]

    def forward(
        self,
        backbone_features: Tensor | np.ndarray,
        state: Tensor | np.ndarray,
        embodiment_id: int | Tensor | np.ndarray,
        *,
        noise: Tensor | np.ndarray,
        num_steps: int | None = None,
        integrator: str | None = None,
        future_refresh: int | None = None,
        previous_chunk: Tensor | np.ndarray | None = None,
        chunking: Chunking | None = None,
        drop_vl: Mask = None,
        attention_mask: Mask = None,
        image_mask: Mask = None,
        intervention: Intervention | Sequence[Intervention] | None = None,
        stop_gradient: Sequence[tuple[Tokens, Tokens]] = (),
    ) -> Tensor:
        """``encode`` followed by ``sample``, which documents the other arguments."""
        return self.sample(
            self.encode(backbone_features, drop_vl=drop_vl),
            state,
            embodiment_id,
            noise=noise,
            num_steps=num_steps,
            integrator=integrator,
            future_refresh=future_refresh,
            previous_chunk=previous_chunk,
            chunking=chunking,
            drop_vl=drop_vl,
            attention_mask=attention_mask,
            image_mask=image_mask,
            intervention=intervention,
            stop_gradient=stop_gradient,
        )

    def sample_time(self, batch: int, generator: torch.Generator | None = None) -> Tensor:
        """Draws flow times for training.

        Args:
            batch: Number of times.
            generator: Default torch's own.

        Returns:
            ``(batch,)``, in [0, scale].
        """
        drawn = self.time_distribution.draw(batch, generator)
        return torch.as_tensor(drawn, dtype=self.dtype, device=self.device)

    def loss(
        self,
        backbone_features: Tensor | np.ndarray,
        state: Tensor | np.ndarray,
        embodiment_id: int | Tensor | np.ndarray,
        actions: Tensor | np.ndarray,
        *,
        noise: Tensor | np.ndarray,
        time: Tensor | np.ndarray,
        action_mask: Tensor | np.ndarray | None = None,
        attention_mask: Mask = None,
        image_mask: Mask = None,
        drop_vl: Mask = None,
    ) -> Tensor:
        """Flow-matching loss: between noise and actions, the velocity should be ``actions - noise``.

        Dimensions that the head encodes and does not decode are 0, as in ``sample``. All decoders have the
        same weight, unlike in a fork that learns the weights (``task_log_sigma``).

        Args:
            backbone_features: ``(B, S, context_dim)``.
            state, embodiment_id: As in ``velocity``.
            actions: The demonstrated chunk, ``(B, T, action_dim)``, normalised.
            noise: The same shape, standard normal.
            time: ``(B,)``, from ``sample_time``.
            action_mask: Weights of the squared errors, broadcast to ``actions``. Default: equal weights.
            attention_mask, image_mask, drop_vl: As in ``trace``.

        Returns:
            A scalar.
        """
        actions, noise, time = self.as_input(actions), self.as_input(noise), self.as_input(time)
        t = time[:, None, None]  # (B, 1, 1)
        noisy = (1 - t) * noise + t * actions  # (B, T, action_dim)
        bucket = torch.floor(time * self.config.num_timestep_buckets).long()  # (B,)
        predicted = self.velocity(
            self.encode(backbone_features, drop_vl=drop_vl),
            state,
            embodiment_id,
            F.pad(noisy, (0, self.config.encoder_action_dim - self.config.action_dim)),
            bucket,
            attention_mask=attention_mask,
            image_mask=image_mask,
            drop_vl=drop_vl,
        )
        mask = None if action_mask is None else self.as_input(action_mask)
        return flow_matching_error(predicted, actions, noise, mask)
