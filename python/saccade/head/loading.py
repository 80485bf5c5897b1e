"""Loading of an action head, and its sizes in memory."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import saccade._saccade as _saccade
from saccade._internal.arrays import (
    ArrayLike,
    Float32Array,
    as_stored,
    check_precision,
    integer,
    optional_integers,
)
from saccade._internal.hub import locate
from saccade._internal.hub_files import HEAD
from saccade._internal.loaded import Loaded
from saccade.head.config import HeadConfig, to_json
from saccade.head.options import optional_integer

HeadT = TypeVar("HeadT", bound="LoadedHead")


class LoadedHead(Loaded[_saccade.ActionHead, HeadConfig]):
    """What :class:`saccade.ActionHead` inherits: its constructors, its sizes and :meth:`warmup`."""

    _engine_class = _saccade.ActionHead
    _config_class = HeadConfig
    _files = HEAD

    @classmethod
    def from_pretrained(
        cls: type[HeadT],
        id_or_path: str | os.PathLike[str],
        *,
        revision: str | None = None,
        config: Mapping[str, Any] | str | os.PathLike[str] | None = None,
        embodiment_ids: Sequence[int] | None = None,
        action_horizon: int | None = None,
        num_states: int | None = None,
        precision: str = "float32",
        num_threads: int | None = None,
    ) -> HeadT:
        """Loads a head from a checkpoint.

        The tensors of the head have the prefix ``action_head.``, ``_groot_model.action_head.`` or none.
        Tensors outside the prefix are ignored. Inside it every tensor must be known, present and of the right
        shape. Tensors that ``saccade quantize`` stored as int8 or int4 can be loaded at every
        precision.

        Args:
            id_or_path: A directory (``config.json`` and one or more ``.safetensors`` files, with or without
                an index), one ``.safetensors`` file, or the id of a published checkpoint, such as
                ``nvidia/GR00T-N1.5-3B``. What exists on this machine is a path. The files of an id are
                downloaded if ``huggingface_hub`` is installed (the extra ``hub``), and kept in its cache.
            revision: A branch, tag or commit of the id. Default: ``main``.
            config: A dict or the path of a JSON file: the config of a whole checkpoint (with
                ``action_head_cfg``, or flat as those of N1.6 and N1.7) or of the head alone.
                Default: the ``config.json`` in the directory of the weights. A config that lerobot wrote does
                not contain the sizes of the head, so they are read from the shapes of the tensors.
            embodiment_ids: Load the layers of these embodiments only. Ids keep their numbers. Default: all.
            action_horizon: Number of actions that the head denoises, for fine-tunes whose config gives
                another number than they were trained with. At most ``max_positions`` if the head adds
                positions to the actions. Default: that of the config. The ``config.json`` of a lerobot policy
                has none, so it is that of the published model that lerobot starts from: 16 for N1.5, 40 for
                N1.7, whatever ``chunk_size`` is.
            num_states: Number of states in an observation, for models that were trained with several
                (``observation_indices`` of the data config of N1 and N1.5, ``delta_indices`` of the states
                of N1.6). Each has a state row of its own. Default: 1. N1.7 makes one row of
                ``config.state_history`` states and takes no other number.
            precision: How the head computes. The residual stream, norms, softmax and all sums of floating
                point products are float32 at every precision.

                - ``"float32"``: exact up to rounding. Weights stored as bfloat16 stay so, without loss.
                - ``"bfloat16"``: weights, inputs of linear layers, keys and values are rounded to bfloat16.
                  Half the memory of float32, and faster on a CPU with a bfloat16 dot product.
                - ``"int8"``: the attention and feed-forward layers of all blocks multiply 8-bit integers,
                  with a scale for each output of the weights and one for each row of the inputs. About a
                  quarter of the memory, and the fastest. Everything else is as in ``"bfloat16"``.
                - ``"int4"``: as ``"int8"``, with weights of four bits in these layers. The smallest, and less
                  accurate.

                ``docs/precision.md`` has the measured accuracy of each.
            num_threads: Number of threads that a call uses. Default: the environment variable
                ``SACCADE_NUM_THREADS``, else the number of physical cores that the process may use (CPU
                affinity and container quota included).

        Raises:
            FileNotFoundError: ``id_or_path`` or the config does not exist, or cannot be downloaded.
            PermissionError: The Hub denies access to the id.
            CheckpointError: The config or the weights are damaged or do not fit each other. The message lists
                every problem.
            InputError: An option is out of range.
        """
        check_precision(precision)
        options = {  # in the order of the engine's arguments
            "config": None if config is None else to_json(config),
            "embodiment_ids": optional_integers("embodiment_ids", embodiment_ids),
            "action_horizon": optional_integer("action_horizon", action_horizon),
            "num_states": optional_integer("num_states", num_states),
            "precision": precision,
            "num_threads": optional_integer("num_threads", num_threads),
        }
        return cls._load(locate(id_or_path, revision, files=HEAD), options)

    @classmethod
    def from_tensors(
        cls: type[HeadT],
        tensors: Mapping[str, ArrayLike],
        *,
        config: Mapping[str, Any] | str | os.PathLike[str],
        embodiment_ids: Sequence[int] | None = None,
        num_states: int | None = None,
        precision: str = "float32",
        num_threads: int | None = None,
    ) -> HeadT:
        """Creates a head from tensors in memory.

        The result has the bits of :meth:`from_pretrained` for a file with these tensors, and keeps no
        reference to them. They are packed one at a time, and only the layers of the requested embodiments are
        read. A tensor that is not C-contiguous is copied first. Such a head cannot be pickled, because it has
        no file to be loaded from.

        Args:
            tensors: The tensors of the head by their names in a checkpoint, without prefix (the state dict of
                a released head), as NumPy arrays or torch CPU tensors. float32 and bfloat16 are kept, float16
                is widened to float32, which is exact. All tensors that the config asks for must be present.
                Others are refused, except those that only training uses (``task_log_sigma.*``,
                ``mask_token``) and ``dropout_prob_by_embodiment`` (see the class).
            config, embodiment_ids, num_states, precision, num_threads: As for :meth:`from_pretrained`.

        Raises:
            DtypeError: A tensor has another dtype, or is not on the CPU.
            ShapeError: Shapes do not fit the config.
            CheckpointError: Tensors are missing or unknown, or the config is damaged. This message and those
                of the two errors above list every problem.
            FileNotFoundError: The config does not exist.
            InputError: An option is out of range, or a name is not valid Unicode.
        """
        check_precision(precision)
        engine = _saccade.ActionHead.from_tensors(
            config=to_json(config),
            embodiment_ids=optional_integers("embodiment_ids", embodiment_ids),
            num_states=optional_integer("num_states", num_states),
            precision=precision,
            num_threads=optional_integer("num_threads", num_threads),
            tensors=as_stored(tensors),
        )
        return cls(engine)

    @property
    def config(self) -> HeadConfig:
        """Sizes and switches of the head."""
        return self._config

    @property
    def future_tokens(self) -> Float32Array:
        """A copy of the learned future tokens, ``(num_future_tokens, width)`` float32.

        They are as they enter the first block. :class:`saccade.Intervention` can replace them in a call.
        """
        return self._engine.future_tokens()

    @property
    def embodiment_ids(self) -> tuple[int, ...]:
        """The loaded embodiments, in ascending order."""
        return tuple(self._engine.embodiment_ids)

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
            num_samples, future_refresh: As the calls give them to :meth:`saccade.ActionHead.sample`.

        Raises:
            InputError: A size is not an integer of at least 1.
            MemoryError: There is not enough memory.
        """
        self._engine.warmup(
            integer("num_vl_tokens", num_vl_tokens),
            integer("batch", batch),
            optional_integer("num_samples", num_samples),
            optional_integer("future_refresh", future_refresh),
        )

    def __repr__(self) -> str:
        config = self._config
        return (
            f"<saccade.ActionHead {config.version} width={config.width} num_layers={config.num_layers} "
            f"num_future_tokens={config.num_future_tokens} precision={self.precision} isa={self.isa} "
            f"num_threads={self.num_threads}>"
        )
