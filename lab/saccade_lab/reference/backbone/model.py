"""The GR00T backbones as torch modules: camera frames and a prompt in, features of the action head out.

Module names follow the checkpoint, so that ``state_dict()`` has the released names below ``backbone.``.
Shapes in comments: B is the batch, T the tokens of a prompt, N the image tokens of all views.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from os import PathLike
from typing import Any

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

    def forward(self, inputs: BackboneInputs) -> BackboneFeatures:
        """Computes the features of a batch.

        Raises:
            ShapeError: Pixel values do not have the shape that the version takes.
            InputError: A token is not in the table, or the image tokens of the prompts are not those of the
                views.
        """
        ids = torch.from_numpy(inputs.input_ids)  # (B, T)
        mask = torch.from_numpy(inputs.attention_mask)  # (B, T)
        vocabulary = self.sizes.text.vocabulary
        if ids.numel() and (int(ids.min()) < 0 or int(ids.max()) >= vocabulary):
            raise InputError(
                f"input_ids: expected 0 to {vocabulary - 1}, got {int(ids.min())} to {int(ids.max())}"
            )
        device = next(self.parameters()).device
        ids, mask = ids.to(device), mask.to(device)
        features = (self.eagle_model if self.sizes.version == "n1.5" else self.model)(inputs, ids, mask)
        if self.sizes.project_to_dim is not None:
            features = self.eagle_linear(features)
        return BackboneFeatures(features, mask, ids == self.sizes.image_token)


class Eagle(nn.Module):
    """N1.5 and N1.6: SigLIP, a connector and Qwen3. The features are behind the last norm."""

    def __init__(self, sizes: BackboneSizes, embeddings: nn.Module) -> None:
        super().__init__()
        self.sizes = sizes
        self.vision_model = VisionModel(sizes.vision, embeddings)
        inputs = sizes.vision.width * sizes.merge**2
        self.mlp1 = connector(inputs, sizes.text.width, sizes.connector_layers)
        self.language_model = LanguageModel(sizes.text, sizes.num_layers)

    def forward(self, inputs: BackboneInputs, ids: Tensor, mask: Tensor) -> Tensor:
        """Inputs with their ids and mask, ``(B, T)``, to ``(B, T, width)``."""
        decoder = self.language_model.model
        weight = decoder.embed_tokens.weight
        tokens = [self.image_tokens(views.to(weight)) for views in self.views(inputs)]
        x = with_image_tokens(decoder.embed_tokens(ids), ids == self.sizes.image_token, torch.cat(tokens))
        # Positions count padding.
        positions = torch.arange(ids.shape[1], device=ids.device).expand(ids.shape)
        text = self.sizes.text
        angles = text_angles(positions, text.theta, text.head_dim // 2, weight.dtype)  # (B, T, head_dim / 2)
        return decoder(x, angles, mask)

    def views(self, inputs: BackboneInputs) -> list[Tensor]:
        """The views, together where they have the same size: each ``(V, 3, height, width)``."""
        pixels = inputs.pixel_values
        grouped = [torch.from_numpy(view) for view in (pixels if isinstance(pixels, tuple) else [pixels])]
        side = self.sizes.vision.patch_size * self.sizes.merge
        for views in grouped:
            shape = tuple(views.shape)
            if len(shape) != 4 or shape[1] != 3 or shape[2] % side or shape[3] % side or 0 in shape:
                raise ShapeError(
                    f"pixel_values: expected (views, 3, height, width), multiples of {side}, got {shape}"
                )
            patches = shape[2] * shape[3] // self.sizes.vision.patch_size**2
            if self.sizes.version == "n1.5" and patches != self.sizes.vision.num_positions:
                raise ShapeError(
                    f"pixel_values: expected {self.sizes.vision.num_positions} patches, got {patches}"
                )
        return grouped

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

    def forward(self, inputs: BackboneInputs, ids: Tensor, mask: Tensor) -> Tensor:
        """Inputs with their ids and mask, ``(B, T)``, to ``(B, T, width)``."""
        sizes, decoder = self.sizes, self.language_model
        weight = decoder.embed_tokens.weight
        patches, grids = self.patches(inputs)
        tokens, stacked = self.visual(patches.to(weight), grids)  # (N, width) each
        image_mask = ids == sizes.image_token
        x = with_image_tokens(decoder.embed_tokens(ids), image_mask, tokens)
        # From the inputs, which are on the CPU: `ids` and `mask` would have to be read back from a GPU.
        given = torch.from_numpy(inputs.input_ids), torch.from_numpy(inputs.attention_mask)
        positions = prompt_positions(*given, grids, sizes).to(ids.device)  # (3, B, T)
        text = sizes.text
        angles = interleaved_angles(positions, text.theta, text.head_dim // 2, text.sections, weight.dtype)
        return decoder(x, angles, mask, added_after(stacked, image_mask))

    def patches(self, inputs: BackboneInputs) -> tuple[Tensor, list[tuple[int, int]]]:
        """The patches of all views, ``(P, values)``, and the grid of each view."""
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
        return torch.from_numpy(pixels), grids


class Qwen3Vl(nn.Module):
    """The level of N1.7's names above the model."""

    def __init__(self, sizes: BackboneSizes) -> None:
        super().__init__()
        self.model = Qwen3VlModel(sizes)

    def forward(self, inputs: BackboneInputs, ids: Tensor, mask: Tensor) -> Tensor:
        """As ``Qwen3VlModel``."""
        return self.model(inputs, ids, mask)


def with_image_tokens(x: Tensor, image_mask: Tensor, tokens: Tensor) -> Tensor:
    """Embedded tokens whose image positions are replaced, prompt after prompt.

    Args:
        x: ``(B, T, width)``.
        image_mask: Bool ``(B, T)``.
        tokens: ``(N, width)``.

    Raises:
        InputError: There are not as many image positions as image tokens.
    """
    places = int(image_mask.sum())
    if places != tokens.shape[0]:
        raise InputError(
            f"input_ids: expected {tokens.shape[0]} image tokens, as many as the views give, got {places}"
        )
    return x.masked_scatter(image_mask[..., None], tokens)


def added_after(stacked: list[Tensor], image_mask: Tensor) -> Callable[[int, Tensor], Tensor]:
    """Adds the deepstack tokens of layer i, ``(N, width)``, to its output at image positions."""

    def add(index: int, x: Tensor) -> Tensor:
        if index >= len(stacked):
            return x
        return x + torch.zeros_like(x).masked_scatter(image_mask[..., None], stacked[index])

    return add
