"""Derivatives of the actions by what the backbone is given: the tokens of the prompt, the pixels of views."""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from saccade._internal.arrays import Float32Array
from saccade.backbone.config import BackboneConfig
from saccade.backbone.inputs import BackboneInputs
from saccade_lab.maps.grid import N17_TIME, by_token, view_pictures
from saccade_lab.maps.layout import Layout
from saccade_lab.reference import ActionHead, Backbone


@dataclass(frozen=True, eq=False)
class InputDerivatives:
    """Root mean squares over the projections of the actions.

    Attributes:
        tokens: ``(T,)``, the norm of the derivative by each token as the language model takes it: an embedded
            word, or a token of a view.
        lengths: ``(T,)``, the length of each of these tokens.
        pixels: The derivative by each pixel value, in the shapes of ``inputs.pixel_values``.
    """

    tokens: Float32Array
    lengths: Float32Array
    pixels: list[Float32Array]


class Taps:
    """Keeps what the vision tower and the language model of a backbone are given.

    Args:
        backbone: The backbone.
    """

    def __init__(self, backbone: Backbone) -> None:
        whole: Any = backbone
        if backbone.sizes.version == "n1.7":
            self._tower: nn.Module = whole.model.model.visual
            self._decoder: nn.Module = whole.model.model.language_model
        else:
            eagle = whole.eagle_model if backbone.sizes.version == "n1.5" else whole.model
            self._tower, self._decoder = eagle.vision_model, eagle.language_model.model
        self.pixels: list[Tensor] = []
        self.tokens: list[Tensor] = []

    @contextlib.contextmanager
    def applied(self) -> Iterator[None]:
        """Keeps them in calls in the context; pixels become leaves of the graph."""

        def before_tower(module: nn.Module, inputs: tuple[Any, ...]) -> tuple[Any, ...]:
            self.pixels.append(inputs[0].detach().requires_grad_())
            return (self.pixels[-1], *inputs[1:])

        def before_decoder(module: nn.Module, inputs: tuple[Any, ...]) -> None:
            self.tokens.append(inputs[0])

        handles = [
            self._tower.register_forward_pre_hook(before_tower),
            self._decoder.register_forward_pre_hook(before_decoder),
        ]
        try:
            yield
        finally:
            for handle in handles:
                handle.remove()


def feature_derivatives(head: ActionHead, features: Tensor, by_vl: Tensor) -> Tensor:
    """Derivatives by the backbone's features, from those by the tokens that the head's blocks read.

    Args:
        head: The head.
        features: ``(1, T, context_dim)``.
        by_vl: Derivatives by what :meth:`ActionHead.encode` returns, ``(projections, T, context_dim)``.

    Returns:
        ``(projections, T, context_dim)``.
    """
    leaf = features.detach().requires_grad_()
    encoded = head.encode(leaf)
    found = [torch.autograd.grad(encoded, leaf, one[None], retain_graph=True)[0] for one in by_vl]
    return torch.cat(found)


def input_derivatives(backbone: Backbone, inputs: BackboneInputs, by_features: Tensor) -> InputDerivatives:
    """Derivatives by tokens and pixels, from those by the features.

    In N1.7 the vision tower also adds to tokens behind the first layers of the language model. That is in the
    derivatives by pixels, and not in those by tokens.

    Args:
        backbone: Backbone without gradients for its weights.
        inputs: A batch of one.
        by_features: ``(projections, T, feature_dim)``.
    """
    taps = Taps(backbone)
    with taps.applied():
        features = backbone(inputs).backbone_features  # (1, T, feature_dim)
    (tokens,) = taps.tokens  # (1, T, width)
    squares = torch.zeros(tokens.shape[1])
    pixels = [torch.zeros_like(one, requires_grad=False) for one in taps.pixels]
    for one in by_features:
        found = torch.autograd.grad(features, [tokens, *taps.pixels], one[None], retain_graph=True)
        squares += found[0][0].square().sum(dim=-1)
        for total, derivative in zip(pixels, found[1:], strict=True):
            total += times_joined(derivative, backbone).square()
    count = len(by_features)
    return InputDerivatives(
        tokens=(squares / count).sqrt().numpy(),
        lengths=tokens.detach()[0].norm(dim=-1).numpy(),
        pixels=[(total / count).sqrt().numpy() for total in pixels],
    )


def times_joined(derivative: Tensor, backbone: Backbone) -> Tensor:
    """The derivative by pixels, of which N1.7 is given each twice: their sum in the place of both."""
    if backbone.sizes.version != "n1.7":
        return derivative
    twice = derivative.reshape(len(derivative), 3, N17_TIME, -1)
    return twice.sum(dim=2, keepdim=True).expand_as(twice).reshape(derivative.shape)


def by_image_token(
    found: InputDerivatives, inputs: BackboneInputs, config: BackboneConfig, layout: Layout
) -> dict[str, Float32Array]:
    """The norm of the derivative by the pixels behind each image token, ``(rows, columns)``, by view."""
    is_listed = isinstance(inputs.pixel_values, tuple)
    pictures = view_pictures(found.pixels if is_listed else found.pixels[0], inputs, config)
    return {
        camera.name: np.sqrt(np.square(by_token(picture, config)).sum(axis=(2, 3)))
        for camera, picture in zip(layout.cameras, pictures, strict=True)
    }


def part_rows(
    found: InputDerivatives, layout: Layout, by_view: dict[str, Float32Array]
) -> list[dict[str, Any]]:
    """Rows of the table: by part of the prompt, by view, and by image token.

    Args:
        found: The derivatives.
        layout: What is at each position of the prompt.
        by_view: The norm of the derivative by the pixels of each token, ``(rows, columns)``, by view.

    Returns:
        ``input`` is ``tokens`` or ``pixels``. ``share`` is that of the squares, of ``relative`` for tokens
        and of ``norm`` for pixels: shares add up to 1.
    """
    rows: list[dict[str, Any]] = []
    relative = found.tokens * found.lengths
    whole = float(np.square(relative).sum())
    for part, positions in layout.parts().items():
        squares = float(np.square(relative[positions]).sum())
        rows.append(
            {
                "input": "tokens",
                "part": part,
                "norm": float(np.sqrt(np.square(found.tokens[positions]).sum())),
                "relative": float(np.sqrt(squares)),
                "share": squares / whole if whole else None,
            }
        )
    whole = sum(float(np.square(norms).sum()) for norms in by_view.values())
    for view, norms in by_view.items():
        squares = float(np.square(norms).sum())
        share = squares / whole if whole else None
        rows.append({"input": "pixels", "part": view, "norm": float(np.sqrt(squares)), "share": share})
        rows += [
            {"input": "pixels", "part": view, "row": row, "column": column, "norm": float(norm)}
            for (row, column), norm in np.ndenumerate(norms)
        ]
    return rows
