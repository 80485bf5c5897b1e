"""The GR00T backbones as torch modules: camera frames and a prompt in, features of the action head out.

Module names follow the checkpoint, so that ``state_dict()`` has the released names below ``backbone.``.
Shapes in comments: B is the batch, T the tokens of a prompt, N the image tokens of all views.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from saccade._internal.hub import resolve
from saccade._internal.hub_files import BACKBONE
from saccade.backbone.inputs import BackboneInputs
from saccade.errors import InputError, ShapeError
from saccade_lab.backbone_sizes import BackboneSizes
from saccade_lab.reference.backbone import loading
from saccade_lab.reference.backbone.qwen3 import Decoder, LanguageModel
from saccade_lab.reference.backbone.qwen3_vl import VisionTower, prompt_positions
from saccade_lab.reference.backbone.rotary import interleaved_angles, text_angles
from saccade_lab.reference.backbone.siglip import (
    ConvolutionEmbeddings,
    LinearEmbeddings,
    VisionModel,
    connector,
    join_squares,
)


@dataclass(frozen=True)
class BackboneFeatures:
    """What a backbone returns."""

    backbone_features: Tensor
    """`(B, T, features_width)`, in the dtype of the parameters."""
    attention_mask: Tensor
    """bool `(B, T)`, as it was given."""
    image_mask: Tensor
    """bool `(B, T)`: True for image tokens."""
    image_places: Tensor
    """Where these are among the `B * T` tokens, `(N,)`."""


@dataclass(frozen=True)
class PreparedInputs:
    """The checked inputs of a backbone on its device. Computing on them reads nothing back from a GPU.

    Attributes:
        pixels: In the dtype of the parameters: ``(V, 3, height, width)`` for the views of one size. N1.7:
            the patches of all views, ``(P, values)``.
        grids: Rows and columns of patches of each view, those of the first prompt first.
        input_ids: ``(B, T)``.
        attention_mask: Bool ``(B, T)``.
        image_places: See ``BackboneFeatures``.
        positions: Of the tokens, ``(B, T)``. N1.7: on the axes of time, height and width, ``(3, B, T)``.
    """

    pixels: list[Tensor]
    grids: list[tuple[int, int]]
    input_ids: Tensor
    attention_mask: Tensor
    image_places: Tensor
    positions: Tensor


class Backbone(nn.Module):
    """The backbone of GR00T N1.5, N1.6 or N1.7 in torch.

    It computes in the dtype of its parameters (``.double()`` for float64) and is differentiable in all of
    them. Nothing is cached or skipped, and logits are not computed. In a padded batch, padded rows attend to
    nothing, as in the released code under torch's SDPA. Wrap calls in ``torch.no_grad()`` if no gradient is
    needed.

    Args:
        sizes: Sizes and switches.

    Example:
        >>> import numpy as np
        >>> from saccade import BackboneInputs
        >>> from saccade_lab.random_checkpoint import small_backbone
        >>> backbone = Backbone(BackboneSizes.from_config(small_backbone("n1.5")))
        >>> prompt = [[1, 2] + [backbone.sizes.image_token] * 16 + [3]]
        >>> features = backbone(BackboneInputs(np.zeros((1, 3, 56, 56), np.float32), prompt))
        >>> features.backbone_features.shape, int(features.image_mask.sum())
        (torch.Size([1, 19, 128]), 16)
    """

    def __init__(self, sizes: BackboneSizes) -> None:
        super().__init__()
        self.sizes = sizes
        if sizes.version == "n1.5":
            self.eagle_model = Eagle(sizes, ConvolutionEmbeddings(sizes.vision))
            if sizes.project_to_dim is not None:
                self.eagle_linear = nn.Linear(sizes.text.width, sizes.project_to_dim)
        else:
            is_eagle = sizes.version == "n1.6"
            self.model = Eagle(sizes, LinearEmbeddings(sizes.vision)) if is_eagle else Qwen3Vl(sizes)

    @classmethod
    def from_pretrained(
        cls,
        id_or_path: str | PathLike[str],
        *,
        revision: str | None = None,
        config: Mapping[str, Any] | str | PathLike[str] | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> Backbone:
        """Loads the backbone from a checkpoint.

        Args:
            id_or_path: A directory or a file in any layout that
                :meth:`saccade.Backbone.from_pretrained` reads, or the id of a published checkpoint.
            revision: A branch, tag or commit of the id. Default: ``main``.
            config: As for :meth:`saccade_lab.backbone_sizes.BackboneSizes.from_config`, or the path
                of such a file. Default: the ``config.json`` in the same directory, or else the ``about``
                entry in the metadata of a single file.
            dtype: Dtype of the parameters. Narrower stored dtypes are widened, which is exact.

        Raises:
            FileNotFoundError: A path or id does not exist, or cannot be downloaded.
            PermissionError: The Hub denies access to the id.
            CheckpointError: There is no config, or tensors are missing, unknown or of the wrong shape. The
                message lists all of them.
        """
        checkpoint = loading.Checkpoint.open(resolve(id_or_path, revision, files=BACKBONE), config)
        with torch.device("meta"):  # no memory and no time for an initialisation that is replaced
            backbone = cls(checkpoint.sizes)
        shapes = {name: tensor.shape for name, tensor in backbone.state_dict().items()}
        backbone.load_state_dict(checkpoint.read(shapes, dtype), assign=True)
        return backbone

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the parameters, in which everything is computed."""
        return next(self.parameters()).dtype

    @property
    def device(self) -> torch.device:
        """The device of the parameters."""
        return next(self.parameters()).device

    def forward(self, inputs: BackboneInputs | PreparedInputs) -> BackboneFeatures:
        """Computes the features of a batch.

        Raises:
            ShapeError, InputError: As ``prepare``, unless the inputs are prepared.
        """
        prepared = inputs if isinstance(inputs, PreparedInputs) else self.prepare(inputs)
        features = self.core(prepared)
        if self.sizes.project_to_dim is not None:
            features = self.eagle_linear(features)
        is_image = prepared.input_ids == self.sizes.image_token
        return BackboneFeatures(features, prepared.attention_mask, is_image, prepared.image_places)

    @property
    def core(self) -> Eagle | Qwen3VlModel:
        """Tower and language model."""
        core: Any = self.eagle_model if self.sizes.version == "n1.5" else self.model
        return core.model if self.sizes.version == "n1.7" else core

    def prepare(self, inputs: BackboneInputs) -> PreparedInputs:
        """Checks inputs and moves them to the device.

        Raises:
            ShapeError: Pixel values do not have the shape that the version takes.
            InputError: A token is not in the table, or the image tokens of the prompts are not those of the
                views.
        """
        pixels, grids = self.core.views(inputs)
        return self.with_prompts(pixels, grids, inputs.input_ids, inputs.attention_mask)

    def with_prompts(
        self,
        pixels: Sequence[Tensor],
        grids: list[tuple[int, int]],
        input_ids: npt.NDArray[np.int64],
        attention_mask: npt.NDArray[np.bool_],
    ) -> PreparedInputs:
        """Checks prompts against their views, and moves both to the device.

        Args:
            pixels, grids: As in ``PreparedInputs``, on any device and in any dtype.
            input_ids, attention_mask: ``(B, T)``.

        Raises:
            InputError: As ``prepare``.
        """
        ids, mask = torch.from_numpy(input_ids), torch.from_numpy(attention_mask)
        sizes = self.sizes
        if ids.numel() and (int(ids.min()) < 0 or int(ids.max()) >= sizes.text.vocabulary):
            raise InputError(
                f"input_ids: expected 0 to {sizes.text.vocabulary - 1}, got {int(ids.min())} to "
                f"{int(ids.max())}"
            )
        places = (ids == sizes.image_token).flatten().nonzero()[:, 0]
        tokens = sum(rows * columns for rows, columns in grids) // sizes.merge**2
        if len(places) != tokens:
            raise InputError(
                f"input_ids: expected {tokens} image tokens, as many as the views give, got {len(places)}"
            )
        if sizes.version == "n1.7":
            positions = prompt_positions(ids, mask, grids, sizes)
        else:
            positions = torch.arange(ids.shape[1]).expand(ids.shape)  # padding counts
        device = self.device
        return PreparedInputs(
            [views.to(device, self.dtype) for views in pixels],
            grids,
            *(one.to(device) for one in (ids, mask, places, positions)),
        )


class Eagle(nn.Module):
    """N1.5 and N1.6: SigLIP, a connector and Qwen3. The features are behind the last norm."""

    def __init__(self, sizes: BackboneSizes, embeddings: nn.Module) -> None:
        super().__init__()
        self.sizes = sizes
        self.vision_model = VisionModel(sizes.vision, embeddings)
        inputs = sizes.vision.width * sizes.merge**2
        self.mlp1 = connector(inputs, sizes.text.width, sizes.connector_layers)
        self.language_model = LanguageModel(sizes.text, sizes.num_layers)

    def forward(self, inputs: PreparedInputs) -> Tensor:
        """``(B, T, width)``."""
        decoder, text = self.language_model.model, self.sizes.text
        tokens = torch.cat([self.image_tokens(views) for views in inputs.pixels])
        x = with_image_tokens(decoder.embed_tokens(inputs.input_ids), inputs.image_places, tokens)
        # (B, T, head_dim / 2)
        angles = text_angles(inputs.positions, text.theta, text.head_dim // 2, x.dtype)
        return decoder(x, angles, inputs.attention_mask)

    def views(self, inputs: BackboneInputs) -> tuple[list[Tensor], list[tuple[int, int]]]:
        """The pixels and grids of ``PreparedInputs``."""
        pixels = inputs.pixel_values
        grouped = [torch.from_numpy(view) for view in (pixels if isinstance(pixels, tuple) else [pixels])]
        return grouped, [grid for views in grouped for grid in self.grids(views)]

    def grids(self, views: Tensor) -> list[tuple[int, int]]:
        """The grid of each of some views, ``(V, 3, height, width)``.

        Raises:
            ShapeError: They do not have the shape that the version takes.
        """
        vision = self.sizes.vision
        side = vision.patch_size * self.sizes.merge
        shape = tuple(views.shape)
        if len(shape) != 4 or shape[1] != 3 or shape[2] % side or shape[3] % side or 0 in shape:
            raise ShapeError(
                f"pixel_values: expected (views, 3, height, width), multiples of {side}, got {shape}"
            )
        rows, columns = (pixels // vision.patch_size for pixels in shape[2:])
        if self.sizes.version == "n1.5" and rows * columns != vision.num_positions:
            raise ShapeError(f"pixel_values: expected {vision.num_positions} patches, got {rows * columns}")
        return [(rows, columns)] * len(views)

    def image_tokens(self, views: Tensor) -> Tensor:
        """``(V, 3, height, width)`` to ``(V * tokens of a view, width)``."""
        sizes = self.sizes
        rows, columns = (side // sizes.vision.patch_size for side in views.shape[2:])
        patches = self.vision_model(views)  # (V, rows * columns, vision_width)
        squares = join_squares(
            patches, rows, columns, sizes.merge, channels_first=sizes.version == "n1.6"
        )  # (V, tokens of a view, vision_width * merge**2)
        return self.mlp1(squares).flatten(0, 1)


class Qwen3VlModel(nn.Module):
    """N1.7's tower and language model. The features are before the last norm."""

    def __init__(self, sizes: BackboneSizes) -> None:
        super().__init__()
        self.sizes = sizes
        self.visual = VisionTower(sizes)
        self.language_model = Decoder(sizes.text, sizes.num_layers, last_norm=False)

    def forward(self, inputs: PreparedInputs) -> Tensor:
        """``(B, T, width)``."""
        decoder, text = self.language_model, self.sizes.text
        (patches,) = inputs.pixels
        tokens, stacked = self.visual(patches, inputs.grids)  # (N, width) each
        x = with_image_tokens(decoder.embed_tokens(inputs.input_ids), inputs.image_places, tokens)
        angles = interleaved_angles(inputs.positions, text.theta, text.head_dim // 2, text.sections, x.dtype)
        return decoder(x, angles, inputs.attention_mask, added_after(stacked, inputs.image_places))

    def views(self, inputs: BackboneInputs) -> tuple[list[Tensor], list[tuple[int, int]]]:
        """The pixels and grids of ``PreparedInputs``."""
        vision, pixels = self.sizes.vision, inputs.pixel_values
        values = 3 * vision.temporal_patch_size * vision.patch_size**2
        if isinstance(pixels, tuple) or pixels.ndim != 2 or pixels.shape[1] != values:
            shape = [view.shape for view in pixels] if isinstance(pixels, tuple) else pixels.shape
            raise ShapeError(f"pixel_values: expected (patches, {values}), got {shape}")
        if inputs.image_grid_thw is None:
            raise InputError("image_grid_thw: expected the grid of each view, got None")
        grids = [(int(rows), int(columns)) for _, rows, columns in inputs.image_grid_thw]
        whole = all(side > 0 and side % self.sizes.merge == 0 for grid in grids for side in grid)
        single = bool((inputs.image_grid_thw[:, 0] == 1).all())
        if not whole or not single or sum(rows * columns for rows, columns in grids) != pixels.shape[0]:
            raise InputError(
                f"image_grid_thw: expected one frame a view, {pixels.shape[0]} patches and sides that are "
                f"multiples of {self.sizes.merge}, got {inputs.image_grid_thw.tolist()}"
            )
        return [torch.from_numpy(pixels)], grids


class Qwen3Vl(nn.Module):
    """The level of N1.7's names above the model; it is never called."""

    def __init__(self, sizes: BackboneSizes) -> None:
        super().__init__()
        self.model = Qwen3VlModel(sizes)


def with_image_tokens(x: Tensor, places: Tensor, tokens: Tensor) -> Tensor:
    """Embedded tokens whose image positions are replaced, prompt after prompt.

    Args:
        x: ``(B, T, width)``.
        places: See ``PreparedInputs.image_places``.
        tokens: ``(N, width)``.
    """
    return x.flatten(0, 1).index_copy(0, places, tokens).view_as(x)


def added_after(stacked: list[Tensor], places: Tensor) -> Callable[[int, Tensor], Tensor]:
    """Adds the deepstack tokens of layer i, ``(N, width)``, to its output at image positions."""

    def add(index: int, x: Tensor) -> Tensor:
        if index >= len(stacked):
            return x
        return x.flatten(0, 1).index_add(0, places, stacked[index].to(x.dtype)).view_as(x)

    return add
