"""The action head of every version of GR00T: encode an observation once, sample chunks of actions from it."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from saccade import _saccade
from saccade._arrays import (
    Array,
    ArrayLike,
    Float32Array,
    apart,
    as_stored,
    boolean,
    float32,
    indices,
    int64,
    integer,
    is_torch,
    like_features,
    optional_integers,
    result,
)
from saccade.attention import check_precision
from saccade.chunking import Chunking
from saccade.config import HeadConfig, to_json
from saccade.errors import InputError
from saccade.hub import resolve
from saccade.integrator import check_integrator
from saccade.intervention import Intervention, as_interventions
from saccade.trace import Record, Trace, check_record

if TYPE_CHECKING:
    from saccade.normalizer import Normalizer
    from saccade.policy import Policy


class Context:
    """An encoded observation: immutable, for any number of calls and threads. Made by
    :meth:`ActionHead.encode`.
    """

    def __init__(self, held: _saccade.Context, use_torch: bool, record: Record | None) -> None:
        self._held = held
        self._torch = use_torch
        self._record = record

    @property
    def batch(self) -> int:
        """Observations."""
        return self._held.batch

    @property
    def num_vl_tokens(self) -> int:
        """Vision-language tokens of each observation, removed ones counted."""
        return self._held.num_vl_tokens

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return self._held.nbytes + (0 if self._record is None else self._record.nbytes)

    @property
    def record(self) -> Record | None:
        """What ``encode`` was asked to record of the VL self-attention; None if nothing."""
        return self._record

    @property
    def vl_embs(self) -> Array:
        """A copy of what the cross-attention blocks see: ``(batch, T_vl, context_dim)`` float32, zero where
        ``drop_vl`` was true.
        """
        return like_features(self._held.vl_embs(), self._torch)

    @property
    def image_mask(self) -> Array | None:
        """The bool ``(batch, T_vl)`` mask given to ``encode``, or None."""
        mask = self._held.image_mask()
        return None if mask is None else like_features(mask, self._torch)

    def __repr__(self) -> str:
        return f"<saccade.Context batch={self.batch} num_vl_tokens={self.num_vl_tokens} nbytes={self.nbytes}>"


class ActionHead:
    """A loaded action head. Made by :meth:`load` or :meth:`from_tensors`; immutable, for any number of
    threads.

    A row's result has the same bits in any batch, with any ``num_samples``, at any thread count.

    Example:
        The head of the demo policy that is shipped with the package, on features of two observations:

        >>> import importlib.resources
        >>> import numpy as np, saccade
        >>> demo = importlib.resources.files("saccade") / "sim" / "demo"
        >>> head = saccade.ActionHead.load(demo)
        >>> context = head.encode(np.zeros((2, 60, head.config.context_dim), np.float32))
        >>> state = np.zeros((2, head.config.state_dim), np.float32)
        >>> actions = head.sample(context, state, embodiment_id=0, seed=7)
        >>> actions.shape == (2, head.config.action_horizon, head.config.action_dim)
        True

        Encoded once, sampled often: four chunks for each of the two observations.

        >>> head.sample(context, state, embodiment_id=0, seed=7, num_samples=4).shape
        (2, 4, 16, 4)
    """

    def __init__(
        self, head: _saccade.ActionHead, source: str | None = None, options: dict[str, Any] | None = None
    ) -> None:
        self._head = head
        self._source = source
        self._options = options
        self._config = HeadConfig(**head.config())

    @classmethod
    def load(
        cls,
        source: str | os.PathLike[str],
        *,
        config: Mapping[str, Any] | str | os.PathLike[str] | None = None,
        embodiment_ids: Sequence[int] | None = None,
        precision: str = "float32",
        num_threads: int | None = None,
    ) -> ActionHead:
        """Loads a head from a checkpoint.

        Tensors are found under ``action_head.``, ``_groot_model.action_head.`` or no prefix. What lies
        outside the prefix is ignored; inside it every tensor must be known, present and of the right shape.
        Tensors that ``saccade quantize`` has stored as int8 are taken at every precision.

        Args:
            source: A directory (``config.json`` beside one or more ``.safetensors``, with or without an
                index), one ``.safetensors`` file, or the id of a published checkpoint in the local cache of
                ``huggingface_hub``, such as ``nvidia/GR00T-N1.5-3B``; nothing is downloaded.
            config: A dict or the path of a JSON file: a whole checkpoint config (with ``action_head_cfg``,
                or flat as those of N1.6 and N1.7) or the head's own.
                Default: ``config.json`` beside the weights; of lerobot's, which holds no size of the head,
                sizes come from the tensors.
            embodiment_ids: Keep only these embodiments' layers; ids keep their numbers. Default all.
            precision: What is computed in what. The residual stream, norms, softmax and all sums of floating
                point products are float32 in each.

                - ``"float32"``: exact to rounding. Weights stored as bfloat16 stay so in memory, which loses
                  nothing.
                - ``"bfloat16"``: weights, inputs of linear layers, keys and values are rounded to bfloat16,
                  which keeps 8 bits. Half the memory of float32 weights, and faster where the CPU has a
                  bfloat16 dot product.
                - ``"int8"``: the attention and feed-forward layers of all blocks multiply 8-bit integers: a
                  scale for each output of the weights, one for each row of the inputs. A quarter of the
                  memory, and the fastest. The rest as in ``"bfloat16"``.

                What each costs in accuracy is measured in ``docs/precision.md``.
            num_threads: Threads that a call uses. Default: the environment's ``SACCADE_NUM_THREADS``, else
                the physical cores that the process may use (affinity and container quota counted).

        Raises:
            FileNotFoundError: ``source`` or the config is not there.
            CheckpointError: config or weights are broken or do not fit each other; all that is wrong is
                listed.
            InputError: an option is out of range.
        """
        check_precision(precision)
        path = os.fspath(resolve(source))
        text = None if config is None else to_json(config)
        ids = optional_integers("embodiment_ids", embodiment_ids)
        threads = _optional_integer("num_threads", num_threads)
        head = _saccade.ActionHead.load(path, text, ids, precision, threads)
        options = {"config": text, "embodiment_ids": ids, "precision": precision, "num_threads": threads}
        return cls(head, str(Path(path).absolute()), options)

    @classmethod
    def from_tensors(
        cls,
        tensors: Mapping[str, ArrayLike],
        *,
        config: Mapping[str, Any] | str | os.PathLike[str],
        embodiment_ids: Sequence[int] | None = None,
        precision: str = "float32",
        num_threads: int | None = None,
    ) -> ActionHead:
        """Makes a head of tensors in memory: bit for bit the one that :meth:`load` reads from a file of them.

        Nothing of the caller's memory is kept: what happens to the tensors afterwards does not reach the
        head. They are packed one at a time where they lie, and of layers for each embodiment only the wanted
        ones are read; tensors that are not C-contiguous are copied first, whole. Such a head cannot be
        pickled, since there is nothing to load it from.

        Args:
            tensors: The head's tensors by their names in a checkpoint, without a prefix (the state dict of
                a released head), as NumPy arrays or torch CPU tensors. float32 and bfloat16 stay what they
                are, float16 is widened, which is exact. Every tensor of the config must be there and no
                other, but what only training uses (``task_log_sigma.*``, ``mask_token``,
                ``dropout_prob_by_embodiment``) may be.
            config: The head's config or a whole checkpoint's, as for :meth:`load`.
            embodiment_ids, precision, num_threads: As for :meth:`load`.

        Raises:
            DtypeError: a tensor of another type, or not on the CPU.
            ShapeError: shapes do not fit the config.
            CheckpointError: tensors are missing or unknown; the config is broken. Each of the three lists
                all that is wrong.
            FileNotFoundError: the config is not there.
            InputError: an option is out of range.
        """
        check_precision(precision)
        text = to_json(config)
        ids = optional_integers("embodiment_ids", embodiment_ids)
        threads = _optional_integer("num_threads", num_threads)
        return cls(_saccade.ActionHead.from_tensors(as_stored(tensors), text, ids, precision, threads))

    @property
    def config(self) -> HeadConfig:
        """Sizes and switches."""
        return self._config

    @property
    def embodiment_ids(self) -> tuple[int, ...]:
        """The loaded embodiments, ascending."""
        return tuple(self._head.embodiment_ids)

    @property
    def future_tokens(self) -> Float32Array:
        """A copy of the learned future tokens: ``(num_future_tokens, width)`` float32, as they enter the
        first block. To replace them in a call, change the copy and pass it to :class:`Intervention` as
        ``future_tokens``.
        """
        return self._head.future_tokens()

    @property
    def num_threads(self) -> int:
        """Threads that a call uses."""
        return self._head.num_threads

    @property
    def precision(self) -> str:
        """What it computes in: ``"float32"``, ``"bfloat16"`` or ``"int8"``."""
        return self._head.precision

    @property
    def isa(self) -> str:
        """The instruction set that the kernels use, one of those that :func:`saccade.show_config` lists."""
        return self._head.isa

    @property
    def nbytes(self) -> int:
        """Bytes of weights in memory."""
        return self._head.nbytes

    def warmup(
        self,
        num_vl_tokens: int,
        batch: int = 1,
        num_samples: int | None = None,
        future_refresh: int | None = None,
    ) -> None:
        """Allocates and touches all that calls of this size need, so that the first one is not slow.

        What depends on time alone is computed for the config's own Euler steps. Another ``num_steps``, or
        ``integrator="midpoint"``, asks for other times: make one call with it as well.

        Args:
            num_vl_tokens: T_vl of the calls to come.
            batch: Their batch.
            num_samples: Their ``num_samples``.
            future_refresh: Their ``future_refresh``.

        Raises:
            InputError: a size is not an integer of at least 1.
        """
        self._head.warmup(
            integer("num_vl_tokens", num_vl_tokens),
            integer("batch", batch),
            _optional_integer("num_samples", num_samples),
            _optional_integer("future_refresh", future_refresh),
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
        """Runs what depends on the observation alone: ``vlln``, the VL self-attention, every cross block's
        keys and values, each where the head has them. A block's keys and values are made for the positions
        that it may see, and for no others.

        Args:
            backbone_features: ``(batch, T_vl, context_dim)``.
            attention_mask: bool ``(batch, T_vl)``, True = attended; None stands for all. It acts in the
                cross-attention blocks of heads whose ``config.mask_mode`` is ``"alternate"`` (GR00T N1.6 and
                N1.7), and not in the VL self-attention. The others (N1 and N1.5) ignore padding, as
                released, and take an all-true mask only.
            image_mask: bool ``(batch, T_vl)``, True = image token; kept in the context for maps. With
                ``mask_mode`` ``"alternate"`` it must be given: some blocks see text only, some images only,
                so that each observation needs an attended token of either kind.
            drop_vl: bool ``(batch, T_vl)``, True = removed before the VL self-attention and everywhere
                after, as if it had not been there.
            record: What to keep in ``context.record``, ``"attention"`` and ``"hidden"``: the probabilities of
                each block of the VL self-attention, and the tokens after it. At most 2 GiB.

        Raises:
            ShapeError, DtypeError, InputError: an argument does not fit; NaN or infinity; more than can be
            recorded.
        """
        use_torch = is_torch(backbone_features)
        attention, hidden = check_record(record)
        held, recorded = self._head.encode(
            float32("backbone_features", backbone_features),
            boolean("attention_mask", attention_mask),
            boolean("image_mask", image_mask),
            boolean("drop_vl", drop_vl),
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
        """Samples a chunk of actions: Euler steps from noise.

        Args:
            context: From this head's :meth:`encode`.
            state: ``(batch, state_history, state_dim)``, or ``(batch, state_dim)`` where the history is of
                one; already normalised and padded.
            embodiment_id: An integer, or ``(batch,)`` integers.
            noise: ``(batch, action_horizon, encoder_action_dim)``; with ``num_samples`` an axis of that size
                after batch.
            seed: Whatever ``numpy.random.default_rng`` takes; the noise is its ``standard_normal`` in
                float32. A ``Generator`` advances, an integer repeats the same noise at every call. With
                neither ``noise`` nor ``seed``: fresh entropy.
            num_steps: Steps, 1 to ``num_timestep_buckets``. Default the config's.
            integrator: What a step is: ``"euler"`` (the default, as the released sampler does), or
                ``"midpoint"``, ``x + dt v(x + dt / 2 v(x, t), t + dt / 2)``, which evaluates the velocity
                twice.
            num_samples: Chunks for each observation, from one context. None adds no axis to noise and
                result; any integer adds one.
            future_refresh: The rows of state and future tokens run at every so many evaluations of the
                velocity only: r runs them at evaluations 0, r, 2 r, ... (of Euler's, steps). At the others
                only the action rows run, and self-attention reads the keys and values of the other rows as
                they last were. None and 1 are exact and give the same bits; r from 2 on is faster and an
                approximation. From the number of evaluations on they run at the first one only.
            intervention: What to change inside the head; one, or several that act together. With
                ``future_refresh`` cuts and biases act on the rows that run; a patch of state or future rows
                at a step at which they do not always run is an error. All evaluations of a step are that
                step.
            previous_chunk: The chunk before, ``(batch, rows, action_dim)`` as it left the head (or
                ``encoder_action_dim`` wide), of ``chunking.horizon`` to ``action_horizon`` rows. All samples
                of an observation begin with the same.
            chunking: How much of it is taken over; see :class:`saccade.Chunking`. Both or neither.
            out: Where the result goes: writable float32, C-contiguous, of the result's shape.

        Returns:
            ``(batch, action_horizon, action_dim)``, or ``(batch, num_samples, action_horizon, action_dim)``;
            float32, torch if the features were torch. Normalised, as the head was trained.

        Raises:
            ShapeError, DtypeError, InputError: an argument does not fit; NaN or infinity; both ``noise`` and
            ``seed``; one of ``previous_chunk`` and ``chunking`` without the other.
        """
        held = _held(context)
        samples = _optional_integer("num_samples", num_samples)
        config = self._config
        leading = (held.batch,) if samples is None else (held.batch, samples)
        output = result((*leading, config.action_horizon, config.action_dim), out)
        start = _noise(noise, seed, (*leading, config.action_horizon, config.encoder_action_dim))
        self._head.sample(
            held,
            apart(float32("state", state), output),
            int64("embodiment_id", embodiment_id),
            apart(start, output),
            _optional_integer("num_steps", num_steps),
            check_integrator(integrator),
            samples,
            _optional_integer("future_refresh", future_refresh),
            *_chunking(previous_chunk, chunking, output),
            _plain(intervention),
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
        """:meth:`encode`, then :meth:`sample`."""
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
            context: From this head's :meth:`encode`.
            state: As in :meth:`sample`.
            embodiment_id: An integer, or ``(batch,)`` integers.
            actions: Noisy actions, ``(batch, action_horizon, encoder_action_dim)``, taken as they are: what
                ``sample`` holds at zero is whatever is given.
            timestep: The bucket, 0 to ``num_timestep_buckets - 1``: an integer, or ``(batch,)`` integers.
            intervention: As in :meth:`sample`; this is step 0.

        Returns:
            ``(batch, action_horizon, action_dim)`` float32, torch if the features were torch.

        Raises:
            ShapeError, DtypeError, InputError: an argument does not fit; NaN or infinity.
        """
        held = _held(context)
        output = result((held.batch, self._config.action_horizon, self._config.action_dim), None)
        self._head.velocity(
            held,
            float32("state", state),
            int64("embodiment_id", embodiment_id),
            float32("actions", actions),
            int64("timestep", timestep),
            _plain(intervention),
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
        """Samples like :meth:`sample` and keeps what goes on inside.

        All rows are computed at every step in every block, the last included, where ``sample`` needs those of
        the actions only; so there is no ``future_refresh``. Steps are Euler's.

        Args:
            context, state, embodiment_id, noise, seed, num_steps, intervention: As in :meth:`sample`.
            record: What to keep: ``"attention"``, the probabilities of every block and step, and
                ``"hidden"``, the rows after it.
            blocks: Of which blocks; default all.
            steps: Of which Euler steps; default all.
            max_bytes: A trace that holds more is refused before anything is allocated.

        Returns:
            By ``(step, block)`` the attention ``(batch, heads, queries, keys)`` and the rows ``(batch, rows,
            width)``, and the actions, bit for bit those of ``sample``; float32, torch if the features were
            torch.

        Raises:
            ShapeError, DtypeError, InputError: an argument does not fit; NaN or infinity; both ``noise`` and
            ``seed``; more than ``max_bytes``.

        Example:
            What the future rows look at in the first block, in the mean over heads:

            >>> import importlib.resources
            >>> import numpy as np, saccade
            >>> head = saccade.ActionHead.load(importlib.resources.files("saccade") / "sim" / "demo")
            >>> context = head.encode(np.zeros((1, 60, head.config.context_dim), np.float32))
            >>> state = np.zeros((1, head.config.state_dim), np.float32)
            >>> trace = head.trace(context, state, 0, seed=7, blocks=0, steps=0)
            >>> looks = trace.attention[0, 0][:, :, trace.rows["future"]].mean(axis=1)
            >>> looks.shape == (1, head.config.num_future_tokens, context.num_vl_tokens)
            True
        """
        held = _held(context)
        config = self._config
        start = _noise(noise, seed, (held.batch, config.action_horizon, config.encoder_action_dim))
        attention, hidden = check_record(record)
        (probabilities, kept_rows), rows, actions = self._head.trace(
            held,
            float32("state", state),
            int64("embodiment_id", embodiment_id),
            start,
            _optional_integer("num_steps", num_steps),
            _plain(intervention),
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

    def policy(
        self,
        normalizer: Normalizer | Mapping[str, Any] | str | os.PathLike[str] | None = None,
        embodiment: str | int | None = None,
    ) -> Policy:
        """This head in the robot's units: what the robot is and does, in place of normalised numbers.

        Args:
            normalizer: What turns them into each other, or what :meth:`saccade.Normalizer.load` reads it
                from. Default: the checkpoint that this head was loaded from.
            embodiment: Tag or id of the robot, where the statistics are of several.

        Raises:
            FileNotFoundError, CheckpointError, InputError: as :class:`saccade.Policy`.
        """
        from saccade.policy import Policy

        return Policy(self, normalizer, embodiment)

    def __reduce__(self) -> tuple[Any, ...]:
        if self._source is None:
            raise TypeError(
                "a head made by ActionHead.from_tensors cannot be pickled or copied: it has no file to be "
                "loaded from again; write its tensors to a checkpoint and use ActionHead.load"
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
    """Unpickles a head: the weights are loaded anew."""
    config, rest = options["config"], {name: value for name, value in options.items() if name != "config"}
    return ActionHead.load(source, config=None if config is None else json.loads(config), **rest)


def _held(context: Context) -> _saccade.Context:
    if not isinstance(context, Context):
        raise InputError(f"context: expected what encode returns, got {type(context).__name__}")
    return context._held


def _optional_integer(name: str, value: int | None) -> int | None:
    return None if value is None else integer(name, value)


def _plain(given: Intervention | Sequence[Intervention] | None) -> list[dict[str, Any]]:
    """Interventions in the form that the engine takes: mappings as lists of their items."""

    def plain(one: Any) -> dict[str, Any]:
        patches = [(place, *item) for place, groups in (one.patch or {}).items() for item in groups.items()]
        return {**vars(one), "key_bias": list((one.key_bias or {}).items()), "patch": patches}

    return [plain(one) for one in as_interventions(given)]


def _chunking(
    previous_chunk: ArrayLike | None, chunking: Chunking | None, output: Float32Array
) -> tuple[Float32Array | None, tuple[int, int, float, int | None] | None]:
    """The chunk before and the numbers that say how it is taken over, in the form that the engine takes."""
    if previous_chunk is None and chunking is None:
        return None, None
    if previous_chunk is None or chunking is None:
        given, missing = ("chunking", "previous_chunk") if chunking else ("previous_chunk", "chunking")
        raise InputError(f"previous_chunk, chunking: expected both or neither, got {given} without {missing}")
    if not isinstance(chunking, Chunking):
        raise InputError(f"chunking: expected a saccade.Chunking, got {type(chunking).__name__}")
    numbers = (chunking.overlap, chunking.frozen, chunking.ramp_rate, chunking.horizon)
    return apart(float32("previous_chunk", previous_chunk), output), numbers


def _converted(arrays: dict[Any, Float32Array], use_torch: bool) -> dict[Any, Array]:
    """Arrays by place, as :func:`like_features` gives them."""
    return {place: like_features(array, use_torch) for place, array in arrays.items()}


def _noise(noise: ArrayLike | None, seed: Any, shape: tuple[int, ...]) -> Float32Array:
    """The start of the Euler loop: as given, or drawn."""
    if noise is not None:
        if seed is not None:
            raise InputError("noise, seed: expected at most one of them, got both")
        return float32("noise", noise)
    try:
        generator = np.random.default_rng(seed)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"seed: expected what numpy.random.default_rng takes, got {seed!r} ({error})"
        ) from None
    try:
        return generator.standard_normal(shape, dtype=np.float32)
    except (MemoryError, ValueError) as error:
        raise InputError(f"noise of shape {shape} does not fit in memory: {error}") from None
