"""The vision-language backbone of GR00T: camera views and an instruction in, features out."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import saccade._saccade as _saccade
from saccade._internal.arrays import ArrayLike, as_stored, check_precision, mask_bytes
from saccade._internal.hub import locate
from saccade._internal.hub_files import BACKBONE
from saccade._internal.loaded import Loaded
from saccade.backbone.config import BackboneConfig
from saccade.backbone.features import RECORDS, BackboneFeatures
from saccade.backbone.inputs import BackboneInputs
from saccade.errors import InputError
from saccade.head.config import to_json
from saccade.head.options import optional_integer
from saccade.head.trace import check_record


class Backbone(Loaded[_saccade.Backbone, BackboneConfig]):
    """A loaded backbone. Create one with :meth:`from_pretrained` or :meth:`from_tensors`.

    A backbone is immutable: any number of threads may call it at the same time. The features of an
    observation have the same bits whatever else is in the batch, as long as it has the same padding, and with
    any number of threads.

    Example:
        >>> import saccade
        >>> backbone = saccade.Backbone.from_pretrained("nvidia/GR00T-N1.5-3B")  # doctest: +SKIP
        >>> features = backbone(inputs)  # doctest: +SKIP
        >>> features.backbone_features.shape  # doctest: +SKIP
        (1, 287, 2048)
    """

    _engine_class = _saccade.Backbone
    _config_class = BackboneConfig
    _files = BACKBONE

    @classmethod
    def from_pretrained(
        cls,
        id_or_path: str | os.PathLike[str],
        *,
        revision: str | None = None,
        config: Mapping[str, Any] | str | os.PathLike[str] | None = None,
        precision: str = "float32",
        num_threads: int | None = None,
    ) -> Backbone:
        """Loads the backbone of a checkpoint.

        The tensors of the backbone have the prefix ``backbone.``, ``_groot_model.backbone.`` or none. The
        version is recognised by their names. Tensors outside the prefix are ignored. Inside it every tensor
        must be known, present and of the right shape. The pooling head of SigLIP, ``lm_head`` next to
        ``embed_tokens``, and layers of the language model from ``select_layer`` on are not read.

        Args:
            id_or_path, revision, num_threads: As for :meth:`saccade.ActionHead.from_pretrained`.
            config: A dict or the path of a JSON file: the config of a whole checkpoint, whose
                ``backbone_cfg.eagle_config`` may contain sizes, or that of a backbone alone
                (``vision_config``, ``text_config``, ``eagle``, ``select_layer``, ``project_to_dim``). Sizes
                that it does not contain are those of the published model. Default: the ``config.json`` in the
                directory of the weights, if there is one.
            precision: ``"float32"``, ``"bfloat16"``, ``"int8"`` or ``"int4"``, as for
                :meth:`saccade.ActionHead.from_pretrained`. The token embeddings are kept in bfloat16, in
                float32 if they are not stored in bfloat16 and the precision is float32, and with ``"int8"``
                and ``"int4"`` in int8 with a scale for each row.

        Raises:
            FileNotFoundError, PermissionError, CheckpointError, InputError: As
                :meth:`saccade.ActionHead.from_pretrained`, or there is no backbone.
        """
        check_precision(precision)
        options = {  # in the order of the engine's arguments
            "config": None if config is None else to_json(config),
            "precision": precision,
            "num_threads": optional_integer("num_threads", num_threads),
        }
        return cls._load(locate(id_or_path, revision, files=BACKBONE), options)

    @classmethod
    def from_tensors(
        cls,
        tensors: Mapping[str, ArrayLike],
        *,
        config: Mapping[str, Any] | str | os.PathLike[str] | None = None,
        precision: str = "float32",
        num_threads: int | None = None,
    ) -> Backbone:
        """Creates a backbone from tensors in memory.

        As :meth:`saccade.ActionHead.from_tensors`: the bits are those of a file with these tensors, no
        reference to them is kept, and the backbone cannot be pickled.

        Args:
            tensors: The tensors by their names in a checkpoint, with or without the prefix, as NumPy arrays
                or torch CPU tensors of float32, bfloat16 or float16.
            config: As for :meth:`from_pretrained`. Default: that of the published model.
            precision, num_threads: As for :meth:`from_pretrained`.

        Raises:
            DtypeError, ShapeError, CheckpointError, FileNotFoundError, InputError: As
                :meth:`saccade.ActionHead.from_tensors`.
        """
        check_precision(precision)
        held_config = None if config is None else to_json(config)
        threads = optional_integer("num_threads", num_threads)
        return cls(_saccade.Backbone.from_tensors(as_stored(tensors), held_config, precision, threads))

    @property
    def config(self) -> BackboneConfig:
        """Sizes and switches of the backbone."""
        return self._config

    def __call__(
        self,
        inputs: BackboneInputs,
        *,
        previous: BackboneFeatures | None = None,
        record: Sequence[str] = (),
    ) -> BackboneFeatures:
        """Computes the features of observations.

        Args:
            inputs: Pixels and token ids, as :class:`saccade.Processor` makes them. Padding is reproduced as
                the released code computes it with scaled dot product attention: a row that may not attend to
                anything gets zeros from the attention. In N1.5 and N1.6 padding counts in the positions.
            previous: Features that this backbone computed before. Views whose pixels are the same, byte for
                byte, are not encoded again, and of a prompt that begins in the same way (the same ids,
                padding and views) only the rest is computed. The features have the same bits as without.
            record: The parts of ``features.record``, any of ``"hidden"`` (the rows after each layer of the
                language model), ``"vision"`` (the patches of each view after the vision tower) and
                ``"image_tokens"`` (the tokens of each view). With a record nothing is taken from
                ``previous``.

        Raises:
            ShapeError, DtypeError, InputError: The inputs do not fit the backbone or each other, are not
                finite, or ``previous`` is of another backbone.
            MemoryError: There is not enough memory.
        """
        return self._encode([inputs], [] if previous is None else [previous], record)[0]

    def encode_many(
        self, inputs: Sequence[BackboneInputs], *, previous: Sequence[BackboneFeatures] = ()
    ) -> list[BackboneFeatures]:
        """Computes the features of each of ``inputs`` in one pass. Their prompts may differ in length.

        Nothing is padded. All rows share the linear layers, and all views the vision tower. The features of
        each have the bits that it has alone.

        Args:
            inputs: Pixels and token ids.
            previous: Features that any of the inputs may take from, as in :meth:`__call__`.

        Raises:
            ShapeError, DtypeError, InputError, MemoryError: As :meth:`__call__`.
        """
        return self._encode(list(inputs), list(previous), ())

    def _encode(
        self, inputs: list[BackboneInputs], previous: list[BackboneFeatures], record: Sequence[str]
    ) -> list[BackboneFeatures]:
        kinds = ("inputs", inputs, BackboneInputs), ("previous", previous, BackboneFeatures)
        for name, values, kind in kinds:
            for value in values:
                if not isinstance(value, kind):
                    raise InputError(f"{name}: expected saccade.{kind.__name__}, got {type(value).__name__}")
        keep = check_record(record, RECORDS)
        held = [given._held for given in previous]
        encoded = self._engine.encode([_plain(given) for given in inputs], held, *keep)
        return [
            BackboneFeatures(found, given.view_names, given._is_torch, recorded if any(keep) else None)
            for (found, recorded), given in zip(encoded, inputs, strict=True)
        ]

    def __repr__(self) -> str:
        config = self.config
        return (
            f"<saccade.Backbone {config.version} width={config.width} num_layers={config.num_layers} "
            f"vision_num_layers={config.vision_num_layers} precision={self.precision} isa={self.isa} "
            f"num_threads={self.num_threads}>"
        )


def _plain(inputs: BackboneInputs) -> dict[str, Any]:
    """The inputs as the engine takes them."""
    pixels = inputs.pixel_values
    return {
        "pixel_values": list(pixels) if isinstance(pixels, tuple) else [pixels],
        "input_ids": inputs.input_ids,
        "attention_mask": mask_bytes("attention_mask", inputs.attention_mask),
        "image_grid_thw": inputs.image_grid_thw,
    }
