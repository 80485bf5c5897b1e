"""The action head of every version of GR00T: encode an observation once, sample chunks of actions from it."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import saccade._saccade as _saccade
from saccade._internal.arrays import (
    Array,
    ArrayLike,
    Float32Array,
    apart,
    as_stored,
    check_precision,
    float32,
    indices,
    int64,
    integer,
    is_torch,
    like_features,
    mask_bytes,
    optional_integers,
    result,
)
from saccade._internal.hub import resolve
from saccade.errors import DtypeError, InputError
from saccade.head.chunking import Chunking
from saccade.head.config import HeadConfig, to_json
from saccade.head.context import Context
from saccade.head.intervention import Intervention
from saccade.head.options import (
    check_integrator,
    noise_or_draw,
    optional_integer,
    plain_chunking,
    plain_interventions,
)
from saccade.head.trace import Record, Trace, check_record


class ActionHead:
    """A loaded action head. Create one with :meth:`from_pretrained` or :meth:`from_tensors`.

    A head is immutable: any number of threads may call it at the same time. The result of an observation has
    the same bits in any batch, with any ``num_samples`` and with any number of threads.

    A checkpoint of GR00T-H may contain ``dropout_prob_by_embodiment``, ``(num_embodiments,)``: how often its
    training set the state of each embodiment to zero. As in the released code, the states of embodiments with
    an entry above 0.999 are set to zero here too, so they have no effect. The other entries act in training
    only. The tensor is ignored if ``state_dropout_prob_per_embodiment`` is null or empty in the config.

    Example:
        The head of the bundled demo policy, on the features of two observations:

        >>> import importlib.resources
        >>> import numpy as np, saccade
        >>> demo = saccade.demo_checkpoint()
        >>> head = saccade.ActionHead.from_pretrained(demo)
        >>> context = head.encode(np.zeros((2, 60, head.config.context_dim), np.float32))
        >>> state = np.zeros((2, head.config.state_dim), np.float32)
        >>> actions = head.sample(context, state, embodiment_id=0, seed=7)
        >>> actions.shape == (2, head.config.action_horizon, head.config.action_dim)
        True

        One context serves many samples. Here are four chunks for each of the two observations:

        >>> head.sample(context, state, embodiment_id=0, seed=7, num_samples=4).shape
        (2, 4, 16, 4)
    """

    def __init__(
        self,
        head: _saccade.ActionHead,
        source: str | None = None,
        options: dict[str, Any] | None = None,
    ) -> None:
        self._head = head
        self._source = source
        self._options = options
        self._config = HeadConfig(**head.config())

    @classmethod
    def from_pretrained(
        cls,
        id_or_path: str | os.PathLike[str],
        *,
        revision: str | None = None,
        config: Mapping[str, Any] | str | os.PathLike[str] | None = None,
        embodiment_ids: Sequence[int] | None = None,
        action_horizon: int | None = None,
        num_states: int | None = None,
        precision: str = "float32",
        num_threads: int | None = None,
    ) -> ActionHead:
        """Loads a head from a checkpoint.

        The tensors of the head have the prefix ``action_head.``, ``_groot_model.action_head.`` or none.
        Tensors outside the prefix are ignored. Inside it every tensor must be known, present and of the right
        shape. Tensors that ``saccade quantize`` stored as int8 can be loaded at every precision.

        Args:
            id_or_path: A directory (``config.json`` and one or more ``.safetensors`` files, with or without
                an index), one ``.safetensors`` file, or the id of a published checkpoint in the local cache
                of ``huggingface_hub``, such as ``nvidia/GR00T-N1.5-3B``.
            revision: A branch, tag or commit of the id. Default: ``main``.
            config: A dict or the path of a JSON file: the config of a whole checkpoint (with
                ``action_head_cfg``, or flat as those of N1.6 and N1.7) or of the head alone.
                Default: the ``config.json`` in the directory of the weights. A config that lerobot wrote does
                not contain the sizes of the head, so they are read from the shapes of the tensors.
            embodiment_ids: Load the layers of these embodiments only. Ids keep their numbers. Default: all.
            action_horizon: Number of actions that the head denoises, in place of the config's
                ``action_horizon``. At most ``max_positions`` if the head adds positions to the actions. For
                fine-tunes whose config gives another number than they were trained with. Default: that of the
                config. The ``config.json`` of a lerobot policy has none, so it is that of the published model
                that lerobot starts from: 16 for N1.5, 40 for N1.7, whatever ``chunk_size`` is.
            num_states: Number of states in an observation, for models that were trained with several
                (``observation_indices`` of the data config of N1 and N1.5, ``delta_indices`` of the states
                of N1.6). Each has a state row of its own. Default: 1. N1.7 makes one row of
                ``config.state_history`` states and takes no other number.
            precision: How the head computes. The residual stream, norms, softmax and all sums of floating
                point products are float32 at every precision.

                - ``"float32"``: exact up to rounding. Weights stored as bfloat16 stay bfloat16 in memory,
                  which loses nothing.
                - ``"bfloat16"``: weights, inputs of linear layers, keys and values are rounded to bfloat16,
                  which keeps 8 bits. Takes half the memory of float32 weights, and is faster on a CPU with a
                  bfloat16 dot product.
                - ``"int8"``: the attention and feed-forward layers of all blocks multiply 8-bit integers,
                  with a scale for each output of the weights and one for each row of the inputs. Takes a
                  quarter of the memory, and is the fastest. Everything else is as in ``"bfloat16"``.

                ``docs/precision.md`` has the measured accuracy of each.
            num_threads: Number of threads that a call uses. Default: the environment variable
                ``SACCADE_NUM_THREADS``, else the number of physical cores that the process may use (CPU
                affinity and container quota included).

        Raises:
            FileNotFoundError: ``id_or_path`` or the config does not exist.
            CheckpointError: The config or the weights are damaged or do not fit each other. The message lists
                every problem.
            InputError: An option is out of range.
        """
        check_precision(precision)
        path = os.fspath(resolve(id_or_path, revision))
        config_text = None if config is None else to_json(config)
        ids = optional_integers("embodiment_ids", embodiment_ids)
        horizon = optional_integer("action_horizon", action_horizon)
        states = optional_integer("num_states", num_states)
        threads = optional_integer("num_threads", num_threads)
        head = _saccade.ActionHead.load(path, config_text, ids, horizon, states, precision, threads)
        options = {
            "config": config_text,
            "embodiment_ids": ids,
            "action_horizon": horizon,
            "num_states": states,
            "precision": precision,
            "num_threads": threads,
        }
        return cls(head, str(Path(path).absolute()), options)

    @classmethod
    def from_tensors(
        cls,
        tensors: Mapping[str, ArrayLike],
        *,
        config: Mapping[str, Any] | str | os.PathLike[str],
        embodiment_ids: Sequence[int] | None = None,
        num_states: int | None = None,
        precision: str = "float32",
        num_threads: int | None = None,
    ) -> ActionHead:
        """Creates a head from tensors in memory.

        The result has the bits of :meth:`from_pretrained` for a file with these tensors. The head
        keeps no reference to the tensors, so later changes to them have no effect. Tensors are packed one at
        a time, and of the layers of the embodiments only the requested ones are read. A tensor that is not
        C-contiguous is copied first. Such a head cannot be pickled, because it has no file to be loaded from.

        Args:
            tensors: The tensors of the head by their names in a checkpoint, without prefix (the state dict of
                a released head), as NumPy arrays or torch CPU tensors. float32 and bfloat16 are kept, float16
                is widened to float32, which is exact. All tensors that the config asks for must be present.
                Others are refused, except those that only training uses (``task_log_sigma.*``,
                ``mask_token``) and ``dropout_prob_by_embodiment`` (see the class).
            config: The config of the head or of a whole checkpoint, as for :meth:`from_pretrained`.
            embodiment_ids, num_states, precision, num_threads: As for :meth:`from_pretrained`.

        Raises:
            DtypeError: A tensor has another dtype, or is not on the CPU.
            ShapeError: Shapes do not fit the config.
            CheckpointError: Tensors are missing or unknown, or the config is damaged. This message and those
                of the two errors above list every problem.
            FileNotFoundError: The config does not exist.
            InputError: An option is out of range, or a name is not valid Unicode.
        """
        check_precision(precision)
        config_text = to_json(config)
        ids = optional_integers("embodiment_ids", embodiment_ids)
        states = optional_integer("num_states", num_states)
        threads = optional_integer("num_threads", num_threads)
        held = as_stored(tensors)
        return cls(_saccade.ActionHead.from_tensors(held, config_text, ids, states, precision, threads))

    @property
    def config(self) -> HeadConfig:
        """Sizes and switches of the head."""
        return self._config

    @property
    def source(self) -> str | None:
        """Absolute path of the checkpoint that the head was loaded from; None after :meth:`from_tensors`."""
        return self._source

    @property
    def future_tokens(self) -> Float32Array:
        """A copy of the learned future tokens, ``(num_future_tokens, width)`` float32.

        They are as they enter the first block. To replace them in a call, pass other tokens to
        :class:`saccade.Intervention` as ``future_tokens``.
        """
        return self._head.future_tokens()

    @property
    def embodiment_ids(self) -> tuple[int, ...]:
        """The loaded embodiments, in ascending order."""
        return tuple(self._head.embodiment_ids)

    @property
    def num_threads(self) -> int:
        """Number of threads that a call uses."""
        return self._head.num_threads

    @property
    def precision(self) -> str:
        """How the head computes: ``"float32"``, ``"bfloat16"`` or ``"int8"``."""
        return self._head.precision

    @property
    def isa(self) -> str:
        """Instruction set of the kernels, one of those that :func:`saccade.show_config` lists."""
        return self._head.isa

    @property
    def nbytes(self) -> int:
        """Size of the weights in memory, in bytes."""
        return self._head.nbytes

    def warmup(
        self,
        num_vl_tokens: int,
        batch: int = 1,
        num_samples: int | None = None,
        future_refresh: int | None = None,
    ) -> None:
        """Allocates and touches all memory that calls of this size need, so that the first call is not slow.

        Values that depend on time alone are computed for the Euler steps of the config. Another
        ``num_steps``, or ``integrator="midpoint"``, evaluates the velocity at other times. Make one call with
        these options as well.

        Args:
            num_vl_tokens: T_vl of the calls.
            batch: Number of observations of the calls.
            num_samples: ``num_samples`` of the calls.
            future_refresh: ``future_refresh`` of the calls.

        Raises:
            InputError: A size is not an integer of at least 1.
            MemoryError: There is not enough memory.
        """
        self._head.warmup(
            integer("num_vl_tokens", num_vl_tokens),
            integer("batch", batch),
            optional_integer("num_samples", num_samples),
            optional_integer("future_refresh", future_refresh),
        )

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
        values of every cross-attention block, as far as the head has them. Keys and values are computed only
        for positions that a block can attend to.

        Args:
            backbone_features: ``(batch, T_vl, context_dim)``.
            attention_mask: bool ``(batch, T_vl)``, True where a position is attended. Default: everywhere. It
                applies to the cross-attention blocks of heads with ``config.mask_mode == "alternate"`` (GR00T
                N1.6 and N1.7), and not to the VL self-attention. The released N1 and N1.5 ignore padding, so
                these heads accept an all-true mask only.
            image_mask: bool ``(batch, T_vl)``, True for image tokens. The context keeps it for attention
                maps. Required with ``mask_mode == "alternate"``, where some blocks attend to text only and
                others to images only. Each observation must then contain an attended token of each kind.
            drop_vl: bool ``(batch, T_vl)``, True for positions that are removed before the VL self-attention
                and everywhere after it. The result is as if they were not in the input.
            record: What to keep in ``context.record``, any of ``"attention"`` (the probabilities of each
                block of the VL self-attention) and ``"hidden"`` (the tokens after each block). At most 2 GiB.

        Raises:
            ShapeError, DtypeError, InputError: An argument does not fit the head, is not finite, or asks for
                a record of more than 2 GiB.
            MemoryError: There is not enough memory.
        """
        use_torch = is_torch(backbone_features)
        attention, hidden = check_record(record)
        held, recorded = self._head.encode(
            float32("backbone_features", backbone_features),
            mask_bytes("attention_mask", attention_mask),
            mask_bytes("image_mask", image_mask),
            mask_bytes("drop_vl", drop_vl),
            attention,
            hidden,
        )
        kept = [_converted(arrays, use_torch) for arrays in recorded]
        return Context(held, use_torch, Record(*kept) if attention or hidden else None)

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
        out: ArrayLike | None = None,
    ) -> Array:
        """Samples chunks of actions by integrating the velocity from noise.

        Args:
            context: From :meth:`encode` of this head.
            state: ``(batch, num_states, state_dim)``, the newest last, or ``(batch, state_dim)`` for a head
                of one state. Normalised and padded (see :meth:`policy` for states in the robot's units).
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
            future_refresh: The state rows and the future rows are recomputed every ``future_refresh``
                velocity evaluations: at evaluations 0, r, 2 r, ... (for Euler, an evaluation is a step). At
                the others only the action rows are computed, and self-attention uses the latest keys and
                values of the other rows. None and 1 are exact and give the same bits. From 2 on, sampling is
                faster and approximate. If r is not less than the number of evaluations, these rows are
                computed once.
            intervention: One or several :class:`saccade.Intervention`, which act together. With
                ``future_refresh``, cuts and biases act on the rows that are computed. A patch of state or
                future rows at a step where they are not always computed is an error. All evaluations of a
                step belong to that step.
            previous_chunk: The previous chunk, ``(batch, rows, action_dim)`` as the head returned it (or
                ``encoder_action_dim`` wide), with ``chunking.horizon`` to ``action_horizon`` rows. All
                samples of an observation continue the same chunk.
            chunking: How the chunk continues the previous one, see :class:`saccade.Chunking`. Required with
                ``previous_chunk``, and only then.
            out: The array that the result is written to: writable float32, C-contiguous, of the shape of the
                result. It is also returned.

        Returns:
            ``(batch, action_horizon, action_dim)``, or ``(batch, num_samples, action_horizon, action_dim)``.
            float32; a torch tensor if the features were torch. Normalised, as in training.

        Raises:
            ShapeError, DtypeError, InputError: An argument does not fit the head or is not finite, both
                ``noise`` and ``seed`` are given, or only one of ``previous_chunk`` and ``chunking`` is given.
            MemoryError: There is not enough memory.
        """
        held = _held(context)
        samples = optional_integer("num_samples", num_samples)
        config = self._config
        leading = (held.batch,) if samples is None else (held.batch, samples)
        output = result((*leading, config.action_horizon, config.action_dim), out)
        start = noise_or_draw(noise, seed, (*leading, config.action_horizon, config.encoder_action_dim))
        self._head.sample(
            held,
            apart(float32("state", state), output),
            int64("embodiment_id", embodiment_id),
            apart(start, output),
            optional_integer("num_steps", num_steps),
            check_integrator(integrator),
            samples,
            optional_integer("future_refresh", future_refresh),
            *plain_chunking(previous_chunk, chunking, output),
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
            ShapeError, DtypeError, InputError: An argument does not fit the head or is not finite.
            MemoryError: There is not enough memory.
        """
        held = _held(context)
        output = result((held.batch, self._config.action_horizon, self._config.action_dim), None)
        self._head.velocity(
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
        """Samples as :meth:`sample` does, and records attention probabilities and hidden states.

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
            The attention ``(batch, heads, queries, keys)`` and the rows ``(batch, rows, width)`` by ``(step,
            block)``, and the actions, bit for bit those of ``sample``. float32; torch tensors if the features
            were torch.

        Raises:
            ShapeError, DtypeError, InputError: An argument does not fit the head or is not finite, both
                ``noise`` and ``seed`` are given, or the trace exceeds ``max_bytes``.
            MemoryError: There is not enough memory.

        Example:
            What the future rows attend to in the first block, averaged over attention heads:

            >>> import importlib.resources
            >>> import numpy as np, saccade
            >>> head = saccade.ActionHead.from_pretrained(saccade.demo_checkpoint())
            >>> context = head.encode(np.zeros((1, 60, head.config.context_dim), np.float32))
            >>> state = np.zeros((1, head.config.state_dim), np.float32)
            >>> trace = head.trace(context, state, 0, seed=7, blocks=0, steps=0)
            >>> attended = trace.attention[0, 0][:, :, trace.rows["future"]].mean(axis=1)
            >>> attended.shape == (1, head.config.num_future_tokens, context.num_vl_tokens)
            True
        """
        held = _held(context)
        config = self._config
        start = noise_or_draw(noise, seed, (held.batch, config.action_horizon, config.encoder_action_dim))
        attention, hidden = check_record(record)
        (probabilities, kept_rows), rows, actions = self._head.trace(
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

    def __reduce__(self) -> tuple[Any, ...]:
        if self._source is None:
            raise DtypeError(
                "a head made by ActionHead.from_tensors cannot be pickled or copied, because it has no file "
                "to be loaded from: write its tensors to a checkpoint and use ActionHead.from_pretrained"
            )
        return _load, (self._source, self._options)

    def __repr__(self) -> str:
        config = self._config
        return (
            f"<saccade.ActionHead {config.version} width={config.width} num_layers={config.num_layers} "
            f"num_future_tokens={config.num_future_tokens} precision={self.precision} isa={self.isa} "
            f"num_threads={self.num_threads}>"
        )


def _load(source: str, options: dict[str, Any]) -> ActionHead:
    """Unpickles a head by loading its checkpoint again."""
    config, rest = options["config"], {name: value for name, value in options.items() if name != "config"}
    return ActionHead.from_pretrained(source, config=None if config is None else json.loads(config), **rest)


def _held(context: Context) -> _saccade.Context:
    if not isinstance(context, Context):
        raise InputError(f"context: expected what encode returns, got {type(context).__name__}")
    return context._held


def _converted(arrays: dict[Any, Float32Array], use_torch: bool) -> dict[Any, Array]:
    """Arrays by place, as :func:`like_features` returns them."""
    return {place: like_features(array, use_torch) for place, array in arrays.items()}
