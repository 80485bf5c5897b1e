"""The action head of GR00T: encodes an observation once, and samples chunks of actions from it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import saccade._saccade as _saccade
from saccade._internal.arrays import (
    Array,
    ArrayLike,
    Float32Array,
    apart,
    float32,
    indices,
    int64,
    integer,
    is_torch,
    like_features,
    mask_bytes,
    result,
)
from saccade.errors import InputError
from saccade.head.chunking import Chunking
from saccade.head.context import Context
from saccade.head.intervention import Intervention
from saccade.head.loading import LoadedHead
from saccade.head.options import (
    check_guidance,
    check_integrator,
    noise_or_draw,
    optional_integer,
    plain_chunking,
    plain_interventions,
)
from saccade.head.trace import Record, Trace, check_record


class ActionHead(LoadedHead):
    """A loaded action head. Create one with :meth:`from_pretrained` or :meth:`from_tensors`.

    A head is immutable: any number of threads may call it at the same time. The result of an observation has
    the same bits in any batch, with any ``num_samples`` and with any number of threads.

    A checkpoint of GR00T-H may contain ``dropout_prob_by_embodiment``, ``(num_embodiments,)``: how often its
    training set the state of each embodiment to zero. As in the released code, states with an entry above
    0.999 are set to zero here too; other entries act in training only. The tensor is ignored if
    ``state_dropout_prob_per_embodiment`` is null or empty in the config.

    Example:
        The head of the bundled demo policy, on the features of two observations:

        >>> import numpy as np, saccade
        >>> head = saccade.ActionHead.from_pretrained(saccade.demo_checkpoint())
        >>> context = head.encode(np.zeros((2, 60, head.config.context_dim), np.float32))
        >>> state = np.zeros((2, head.config.state_dim), np.float32)
        >>> actions = head.sample(context, state, embodiment_id=0, seed=7)
        >>> actions.shape == (2, head.config.action_horizon, head.config.action_dim)
        True

        One context serves many samples. Here are four chunks for each of the two observations:

        >>> head.sample(context, state, embodiment_id=0, seed=7, num_samples=4).shape
        (2, 4, 16, 4)
    """

    def encode(
        self,
        backbone_features: ArrayLike,
        *,
        attention_mask: ArrayLike | None = None,
        image_mask: ArrayLike | None = None,
        drop_vl: ArrayLike | None = None,
        record: Sequence[str] = (),
    ) -> Context:
        """Computes everything that depends on the observation alone.

        This is the norm of the vision-language tokens (``vlln``), the VL self-attention, and the keys and
        values of each cross-attention block (if present). Keys and values are computed only for positions
        that a block can attend to.

        Args:
            backbone_features: ``(batch, T_vl, context_dim)``.
            attention_mask: bool ``(batch, T_vl)``, True where a position is attended; everywhere by default.
                It applies to the cross-attention blocks of heads with ``config.mask_mode == "alternate"``
                (N1.6, N1.7), not to the VL self-attention. N1 and N1.5 accept an all-true mask only.
            image_mask: bool ``(batch, T_vl)``, True for image tokens. The context keeps it for attention
                maps. Required with ``mask_mode == "alternate"``, where some blocks attend to text only and
                others to images only. Each observation must then contain an attended token of each kind.
            drop_vl: bool ``(batch, T_vl)``, True for positions that are removed before the VL self-attention
                and everywhere after it. The result is as if they were not in the input.
            record: What to keep in ``context.record``, any of ``"attention"`` (the probabilities of each
                block of the VL self-attention) and ``"hidden"`` (the tokens after each block). At most 2 GiB.

        Raises:
            ShapeError, DtypeError, InputError, MemoryError: As :meth:`sample`, or the record is too large.
        """
        use_torch = is_torch(backbone_features)
        attention, hidden = check_record(record)
        held, recorded = self._engine.encode(
            float32("backbone_features", backbone_features),
            mask_bytes("attention_mask", attention_mask),
            mask_bytes("image_mask", image_mask),
            mask_bytes("drop_vl", drop_vl),
            attention,
            hidden,
        )
        kept = Record(*(_converted(arrays, use_torch) for arrays in recorded))
        return Context(held, use_torch, kept if attention or hidden else None)

    def sample(
        self,
        context: Context,
        state: ArrayLike,
        embodiment_id: int | ArrayLike,
        *,
        noise: ArrayLike | None = None,
        seed: Any = None,
        num_steps: int | None = None,
        integrator: str | None = None,
        num_samples: int | None = None,
        future_refresh: int | None = None,
        intervention: Intervention | Sequence[Intervention] | None = None,
        previous_chunk: ArrayLike | None = None,
        chunking: Chunking | None = None,
        guidance: float | None = None,
        without: Context | None = None,
        out: ArrayLike | None = None,
    ) -> Array:
        """Samples chunks of actions by integrating the velocity from noise.

        Args:
            context: From :meth:`encode` of this head.
            state: ``(batch, num_states, state_dim)``, the newest last, or ``(batch, state_dim)`` for a head
                of one state. Normalised and padded: :class:`saccade.Policy` takes the robot's units.
            embodiment_id: One integer, or integers ``(batch,)``.
            noise: ``(batch, action_horizon, encoder_action_dim)``. With ``num_samples``, ``(batch,
                num_samples, action_horizon, encoder_action_dim)``.
            seed: Anything that ``numpy.random.default_rng`` accepts. The noise is drawn with its
                ``standard_normal`` in float32. A ``Generator`` advances; an integer gives the same noise in
                every call. Without ``noise`` and ``seed``, the noise is seeded by the operating system.
            num_steps: Number of steps, 1 to ``num_timestep_buckets``. Default: that of the config.
            integrator: ``"euler"`` (default), as the released sampler, or ``"midpoint"``, ``x + dt v(x + dt /
                2 v(x, t), t + dt / 2)``, which evaluates the velocity twice in each step.
            num_samples: Number of chunks for each observation. With None, noise and result have no axis for
                it. With any integer, 1 included, they have one.
            future_refresh: The state rows and the future rows are recomputed at velocity evaluations 0, r, 2
                r, ... only (for Euler, an evaluation is a step). In between, self-attention uses their latest
                keys and values. None and 1 are exact and give the same bits. From 2 on, sampling is faster
                and approximate. A larger r than there are evaluations computes them once.
            intervention: One or several :class:`saccade.Intervention`, which act together. With
                ``future_refresh``, cuts and biases act on the rows that are computed. A patch of state or
                future rows at a step where they are not always computed is an error. All evaluations of a
                step belong to that step.
            previous_chunk: ``(batch, rows, action_dim)`` as the head returned it (or ``encoder_action_dim``
                wide), with ``chunking.horizon`` to ``action_horizon`` rows. All samples continue this chunk.
            chunking: How the chunk continues the previous one. Required with ``previous_chunk`` only.
            guidance: A weight w of at least 0. With the velocities v of ``context`` and u of ``without`` at
                the same actions, sampling follows ``u + w (v - u)``, at every evaluation: classifier-free
                guidance. None and 1 sample ``context`` alone, with the same bits as without guidance; 0 has
                the result of ``without``; other weights take twice the time. Interventions act in both.
            without: A context of the same observations, such as one without their instructions, from
                :meth:`encode` of this head. Required with ``guidance`` other than 1. It may have another
                number of vision-language tokens.
            out: The array that the result is written to and that is returned: writable, float32,
                C-contiguous, of the shape of the result.

        Returns:
            ``(batch, action_horizon, action_dim)``, or ``(batch, num_samples, action_horizon, action_dim)``.
            float32; a torch tensor if the features were torch. Normalised, as in training.

        Raises:
            ShapeError, DtypeError, InputError: An argument does not fit the head or is not finite, both
                ``noise`` and ``seed`` are given, or only one of ``previous_chunk`` and ``chunking``, or of
                ``guidance`` and ``without``, is given.
            MemoryError: There is not enough memory.
        """
        held = _held(context)
        samples = optional_integer("num_samples", num_samples)
        config = self.config
        leading = (held.batch,) if samples is None else (held.batch, samples)
        output = result((*leading, config.action_horizon, config.action_dim), out)
        start = noise_or_draw(noise, seed, config, held.batch, samples)
        self._engine.sample(
            held,
            apart(float32("state", state), output),
            int64("embodiment_id", embodiment_id),
            apart(start, output),
            optional_integer("num_steps", num_steps),
            check_integrator(integrator),
            samples,
            optional_integer("future_refresh", future_refresh),
            *plain_chunking(previous_chunk, chunking, output),
            _guidance(guidance, without),
            plain_interventions(intervention),
            output,
        )
        return like_features(output, context._torch) if out is None else out  # type: ignore[return-value]

    def __call__(
        self,
        backbone_features: ArrayLike,
        state: ArrayLike,
        embodiment_id: int | ArrayLike,
        *,
        attention_mask: ArrayLike | None = None,
        image_mask: ArrayLike | None = None,
        drop_vl: ArrayLike | None = None,
        noise: ArrayLike | None = None,
        seed: Any = None,
        num_steps: int | None = None,
        integrator: str | None = None,
        num_samples: int | None = None,
        future_refresh: int | None = None,
        intervention: Intervention | Sequence[Intervention] | None = None,
        previous_chunk: ArrayLike | None = None,
        chunking: Chunking | None = None,
        out: ArrayLike | None = None,
    ) -> Array:
        """:meth:`encode` followed by :meth:`sample`, which document the arguments, result and errors."""
        context = self.encode(
            backbone_features, attention_mask=attention_mask, image_mask=image_mask, drop_vl=drop_vl
        )
        return self.sample(
            context,
            state,
            embodiment_id,
            noise=noise,
            seed=seed,
            num_steps=num_steps,
            integrator=integrator,
            num_samples=num_samples,
            future_refresh=future_refresh,
            intervention=intervention,
            previous_chunk=previous_chunk,
            chunking=chunking,
            out=out,
        )

    def velocity(
        self,
        context: Context,
        state: ArrayLike,
        embodiment_id: int | ArrayLike,
        actions: ArrayLike,
        timestep: int | ArrayLike,
        *,
        intervention: Intervention | Sequence[Intervention] | None = None,
    ) -> Array:
        """The velocity that the head predicts for noisy actions.

        Args:
            context: From :meth:`encode` of this head.
            state: As in :meth:`sample`.
            embodiment_id: One integer, or integers ``(batch,)``.
            actions: Noisy actions, ``(batch, action_horizon, encoder_action_dim)``. They are used as given,
                including the dimensions that ``sample`` keeps at zero.
            timestep: The time bucket, 0 to ``num_timestep_buckets - 1``: one integer, or integers
                ``(batch,)``.
            intervention: As in :meth:`sample`. This evaluation is step 0.

        Returns:
            ``(batch, action_horizon, action_dim)`` float32; a torch tensor if the features were torch.

        Raises:
            ShapeError, DtypeError, InputError, MemoryError: As :meth:`sample`.
        """
        held = _held(context)
        output = result((held.batch, self.config.action_horizon, self.config.action_dim), None)
        self._engine.velocity(
            held,
            float32("state", state),
            int64("embodiment_id", embodiment_id),
            float32("actions", actions),
            int64("timestep", timestep),
            plain_interventions(intervention),
            output,
        )
        return like_features(output, context._torch)

    def trace(
        self,
        context: Context,
        state: ArrayLike,
        embodiment_id: int | ArrayLike,
        *,
        noise: ArrayLike | None = None,
        seed: Any = None,
        num_steps: int | None = None,
        intervention: Intervention | Sequence[Intervention] | None = None,
        record: Sequence[str] = ("attention",),
        blocks: int | Sequence[int] | None = None,
        steps: int | Sequence[int] | None = None,
        max_bytes: int = 2**31,
    ) -> Trace[Array]:
        """Samples as :meth:`sample` does, and records what :class:`saccade.Trace` lists and shows.

        All rows are computed in every block at every step, whereas ``sample`` computes only the action rows
        of the last block. There is no ``future_refresh``, and steps are Euler steps.

        Args:
            context, state, embodiment_id, noise, seed, num_steps, intervention: As in :meth:`sample`.
            record: What to record, any of ``"attention"`` (the probabilities) and ``"hidden"`` (the rows
                after a block).
            blocks: The blocks to record. Default: all.
            steps: The Euler steps to record. Default: all.
            max_bytes: A larger trace is refused before anything is allocated.

        Returns:
            The attention, the rows, and the actions, bit for bit those of ``sample``.

        Raises:
            ShapeError, DtypeError, InputError, MemoryError: As :meth:`sample`, or the trace exceeds
                ``max_bytes``.
        """
        held = _held(context)
        config = self.config
        start = noise_or_draw(noise, seed, config, held.batch)
        attention, hidden = check_record(record)
        (probabilities, kept_rows), rows, actions = self._engine.trace(
            held,
            float32("state", state),
            int64("embodiment_id", embodiment_id),
            start,
            optional_integer("num_steps", num_steps),
            plain_interventions(intervention),
            attention,
            hidden,
            indices("blocks", blocks),
            indices("steps", steps),
            integer("max_bytes", max_bytes, least=0),
        )
        return Trace(
            attention=_converted(probabilities, context._torch),
            hidden=_converted(kept_rows, context._torch),
            rows={group: slice(*span) for group, span in rows.items()},
            actions=like_features(actions, context._torch),
        )


def _held(context: Context) -> _saccade.Context:
    if not isinstance(context, Context):
        raise InputError(f"context: expected what encode returns, got {type(context).__name__}")
    return context._held


def _guidance(guidance: float | None, without: Context | None) -> tuple[float, _saccade.Context] | None:
    """Weight and second context as the engine takes them; None where the first context counts alone."""
    if without is None:
        if check_guidance(guidance) is not None:
            raise InputError(
                f"guidance, without: expected both or neither, got guidance {guidance!r} without a context"
            )
        return None
    if guidance is None:
        raise InputError("guidance, without: expected both or neither, got without alone")
    if not isinstance(without, Context):
        raise InputError(f"without: expected what encode returns, got {type(without).__name__}")
    weight = check_guidance(guidance)
    return 1.0 if weight is None else weight, without._held


def _converted(arrays: dict[Any, Float32Array], use_torch: bool) -> dict[Any, Array]:
    """Arrays by place, as :func:`like_features` returns them."""
    return {place: like_features(array, use_torch) for place, array in arrays.items()}
