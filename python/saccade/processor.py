"""The processor: camera frames and an instruction in, the inputs of a backbone out."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

import saccade._saccade as _saccade
from saccade._internal.arrays import ArrayLike, Float32Array, frame, int64, integer
from saccade._internal.arrays import text as checked_text
from saccade._internal.tokenizers import given_tokenizer, processor_source, tokenizer_of
from saccade.backbone.inputs import BackboneInputs
from saccade.errors import InputError, ShapeError

#: The views of one observation: by camera name, or in the order of the prompt.
Frames: TypeAlias = "Mapping[str, ArrayLike] | Sequence[ArrayLike] | npt.NDArray[Any]"
Version: TypeAlias = Literal["n1.5", "n1.6", "n1.7"]
Preprocessing: TypeAlias = Literal["lerobot", "isaac"]

_View: TypeAlias = "tuple[str | None, npt.NDArray[Any]]"


class Processor:
    """Prepares frames and an instruction for the backbone of one version of GR00T.

    Everything is computed in Rust, with the bits of the released processors: crops, resizing, the prompt and
    its tokens. A processor is immutable: any number of threads may use it at the same time.

    Args:
        version: ``"n1.5"``, ``"n1.6"`` or ``"n1.7"``.
        tokenizer: A ``tokenizer.json``; a directory with one, or with ``vocab.json`` and ``merges.txt``; or
            the id of a published repository with one.
        preprocessing: The program that the checkpoint was trained with. ``"lerobot"``: views sorted by name,
            no crop. ``"isaac"`` (Isaac-GR00T): views in the order given, a centre crop of 95 %.
            Default: lerobot's for N1.5, Isaac-GR00T's for N1.6 and N1.7.
        image_size: N1.5: height and width of a view. Default: 224.
        tokens_per_view: N1.5: image tokens of a view. Default: ``(image_size / 14) ** 2``.
        plain_text: N1.5: insert the instruction into the prompt verbatim. Otherwise it is formatted as in the
            released processors, ``['open the drawer']``.
        options: Keys of the released ``processor_config.json`` and ``preprocessor_config.json``, such as
            ``shortest_image_edge``, ``crop_fraction``, ``min_pixels`` or ``formalize_language``. If
            ``use_albumentations`` is among them, they are read as a released file: a key that is missing has
            the default of the released constructor. Otherwise the rest is as in the published checkpoints.

    Raises:
        InputError: An argument or option is unknown, has another type, belongs to another version, or needs
            another one that is null or missing.
        CheckpointError: The tokenizer is broken, or of another kind than the version's. The message lists
            every problem.
        FileNotFoundError: The tokenizer does not exist, or cannot be downloaded.
        PermissionError: The Hub denies access to the id.

    Example:
        >>> import numpy as np, saccade
        >>> processor = saccade.Processor("n1.5", "tokenizer.json")
        >>> frames = {"front": np.zeros((480, 640, 3), np.uint8)}
        >>> inputs = processor(frames, "open the drawer")
        >>> inputs.pixel_values.shape, inputs.view_names
        ((1, 3, 224, 224), ('front',))
        >>> inputs = processor([frames, frames], ["push", "open the drawer"])
        >>> inputs.input_ids.shape, inputs.attention_mask.sum(axis=1)
        ((2, 294), array([292, 294]))
        >>> processor.texts(processor.tokens("push the puck"))
        ['push', ' the', ' ', 'pu', 'ck']
    """

    def __init__(
        self,
        version: Version,
        tokenizer: str | os.PathLike[str],
        *,
        preprocessing: Preprocessing | None = None,
        image_size: int | None = None,
        tokens_per_view: int | None = None,
        plain_text: bool = False,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        if not isinstance(plain_text, bool):
            raise InputError(f"plain_text: expected True or False, got {plain_text!r}")
        self._processor = _saccade.Processor(
            checked_text("version", version),
            given_tokenizer(tokenizer),
            _optional("preprocessing", preprocessing),
            None if image_size is None else integer("image_size", image_size),
            None if tokens_per_view is None else integer("tokens_per_view", tokens_per_view),
            plain_text,
            None if options is None else _to_json(options),
        )

    @classmethod
    def from_pretrained(
        cls,
        id_or_path: str | os.PathLike[str],
        *,
        revision: str | None = None,
        preprocessing: Preprocessing | None = None,
        tokenizer: str | os.PathLike[str] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> Processor:
        """The processor of a checkpoint.

        Version and sizes come from its tensors, options from ``processor_config.json`` (in the folder or, if
        that has none, in its ``processor/``), ``preprocessor_config.json`` or lerobot's
        ``policy_preprocessor.json``. A checkpoint that holds only a backbone will do.

        Args:
            id_or_path, revision: As for :meth:`saccade.ActionHead.from_pretrained`.
            preprocessing: As for the class. Default: lerobot for a checkpoint that lerobot wrote, otherwise
                Isaac-GR00T.
            tokenizer: As for the class. Default: the checkpoint's own, otherwise the published tokenizer of
                its release.
            options: Options that replace those of the checkpoint, such as ``{"letter_box_transform": True}``,
                because some files do not contain the options of the training.

        Raises:
            InputError: As the class, or an option that is given concerns states or actions.
            CheckpointError: The checkpoint or tokenizer is broken or of another kind, or its files have a
                step that is not known.
            FileNotFoundError, PermissionError: As the class. The message names the files and ids.

        Example:
            >>> import saccade
            >>> saccade.Processor.from_pretrained("n1.5-backbone.safetensors", tokenizer="tokenizer.json")
            <saccade.Processor version=n1.5 preprocessing=lerobot image_size=56 tokens_per_view=16 tokens=443>
        """
        held = processor_source(id_or_path, revision)
        chosen = _optional("preprocessing", preprocessing)
        processor = cls.__new__(cls)
        replaced = None if options is None else _to_json(options)
        processor._processor = _saccade.Processor.load(held, tokenizer_of(held, tokenizer), chosen, replaced)
        return processor

    @property
    def version(self) -> str:
        """``"n1.5"``, ``"n1.6"`` or ``"n1.7"``."""
        return self._processor.version

    @property
    def preprocessing(self) -> str:
        """The program whose preprocessing it follows: ``"lerobot"`` or ``"isaac"``."""
        return self._processor.preprocessing

    @property
    def image_size(self) -> int | None:
        """N1.5: height and width of a view. None for N1.6 and N1.7, where they depend on the frame."""
        size = self._processor.view_size
        return None if size is None else size[0]

    @property
    def tokens_per_view(self) -> int | None:
        """N1.5: image tokens of a view. None for N1.6 and N1.7, where they depend on the frame."""
        size = self._processor.view_size
        return None if size is None else size[1]

    def __call__(
        self,
        frames: Frames | Sequence[Frames],
        instruction: str | Sequence[str | None] | None = None,
        *,
        view_names: Sequence[str] | None = None,
        plain_text: bool = False,
    ) -> BackboneInputs:
        """Prepares one observation, or a batch.

        Args:
            frames: ``{name: frame}`` or a sequence of frames. A frame is ``(height, width, 3)`` uint8. With
                lerobot's preprocessing it may also be ``(3, height, width)``, and floating point from 0 to 1:
                values beyond that are clamped, as lerobot does. A batch is a list of observations with the
                same views; its prompts are padded on the left.
            instruction: The task. For a batch, a list with one instruction for each observation. None, and
                with lerobot's preprocessing an empty text, selects the released default.
            view_names: Names of the views of a sequence.
            plain_text: N1.5: insert the instruction verbatim, even if the processor formats instructions as
                lists.

        Raises:
            ShapeError, DtypeError: A frame has the wrong shape or dtype. The message names it.
            InputError: There are no frames, the observations of a batch differ in their views, or an
                instruction is too long, contains a token that stands for an image, or a placeholder such as
                ``<image-2>``, which the released N1.5 would replace by another copy of a frame.
            MemoryError: There is not enough memory.
        """
        observations, instructions = _batch(frames, instruction)
        names = None if view_names is None else [checked_text("view_names", name) for name in view_names]
        given = [
            (_views(seen, names), not isinstance(seen, Mapping), _optional("instruction", task))
            for seen, task in zip(observations, instructions, strict=True)
        ]
        pixels, ids, mask, grid, found = self._processor.process(given, bool(plain_text))
        return BackboneInputs(
            pixels if self.version == "n1.6" else pixels[0], ids, mask, grid, view_names=found
        )

    def frame(self, image: ArrayLike) -> Float32Array:
        """The ``pixel_values`` of one frame.

        Args:
            image: A frame, as in a call.

        Returns:
            N1.5: ``(3, image_size, image_size)``. N1.6: ``(1, 3, height, width)``. N1.7: ``(patches, 1536)``.

        Raises:
            ShapeError, DtypeError, InputError: It is not a frame.
            MemoryError: There is not enough memory.
        """
        return self._processor.frame(frame("image", image))

    def tokens(self, text: str) -> npt.NDArray[np.int64]:
        """The token ids of ``text`` alone, ``(tokens,)``.

        The string of a special token becomes that token.

        Raises:
            InputError: It is not text, or longer than 256 kB.
        """
        return self._processor.tokens(checked_text("text", text))

    def texts(self, ids: ArrayLike | Sequence[int]) -> list[str]:
        """The text of each of these tokens.

        Args:
            ids: ``(tokens,)`` integers.

        Raises:
            ShapeError: ``ids`` does not have one axis.
            InputError: They are not integers, or an id is not that of a token.
        """
        given = int64("ids", ids)
        if given.ndim != 1:
            raise ShapeError(f"ids: expected (tokens,), got shape {given.shape}")
        return self._processor.texts(given.tolist())

    def __repr__(self) -> str:
        view = self._processor.view_size
        size = "" if view is None else f" image_size={view[0]} tokens_per_view={view[1]}"
        return (
            f"<saccade.Processor version={self.version} preprocessing={self.preprocessing}{size} "
            f"tokens={self._processor.num_tokens}>"
        )


def _optional(name: str, value: Any) -> str | None:
    return None if value is None else checked_text(name, value)


def _to_json(options: Any) -> str:
    if not isinstance(options, Mapping):
        raise InputError(f"options: expected a mapping, got {type(options).__name__}")
    try:
        return json.dumps(dict(options), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"options: expected values that JSON can represent: {error}") from None


def _batch(frames: Any, instruction: Any) -> tuple[Sequence[Any], Sequence[str | None]]:
    """Observations and their instructions."""
    is_batch = isinstance(frames, (list, tuple)) and any(
        isinstance(item, (Mapping, list, tuple)) for item in frames
    )
    if isinstance(instruction, (list, tuple)):
        if not is_batch:
            raise InputError(
                f"frames: expected a list of {len(instruction)} observations for as many instructions, got "
                f"{_kind(frames)}"
            )
        if len(instruction) != len(frames):
            raise InputError(
                f"instruction: expected one for each of {len(frames)} observations, got {len(instruction)}"
            )
        return frames, instruction
    if not is_batch:
        return [frames], [instruction]
    if instruction is not None:
        raise InputError(
            f"instruction: expected a list of {len(frames)}, one for each observation, got {instruction!r}"
        )
    return frames, [None] * len(frames)


def _views(frames: Any, names: list[str] | None) -> list[_View]:
    """The frames of an observation with their names."""
    if isinstance(frames, Mapping):
        if names is not None:
            raise InputError("view_names: expected none, since the frames have names")
        return [
            (checked_text("frames", name), frame(f"frames[{name!r}]", image))
            for name, image in frames.items()
        ]
    is_array = getattr(frames, "ndim", None) == 4
    if not is_array and not isinstance(frames, (list, tuple)):
        raise InputError(
            f"frames: expected a mapping of names to frames or a sequence of frames, got {_kind(frames)}"
        )
    if names is not None and len(names) != len(frames):
        raise InputError(f"view_names: expected {len(frames)} names, got {len(names)}")
    return [
        (None if names is None else names[index], frame(f"frames[{index}]", image))
        for index, image in enumerate(frames)
    ]


def _kind(value: Any) -> str:
    shape = getattr(value, "shape", None)
    return type(value).__name__ if shape is None else f"an array of shape {tuple(shape)}"
