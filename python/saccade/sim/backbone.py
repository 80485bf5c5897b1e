"""The vision-language backbone in NumPy: images and words to the tokens that the action head attends to.

A convolutional stem turns each image into one token per patch. Word embeddings and a register token are
appended, and a small transformer mixes all tokens. `learner.py` has the same network in torch for training; a
test compares the two.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade._arrays import Float32Array, UInt8Array
from saccade.errors import CheckpointError, ShapeError

KERNEL, STRIDE, PADDING = 4, 2, 1  # of every convolution: each halves the size of the image
FIRST_CHANNELS = 32
NORM_EPS = 1e-5


@dataclass(frozen=True)
class BackboneConfig:
    """Sizes of the backbone.

    Attributes:
        width: Width of its tokens, the `context_dim` of the head.
        num_layers: Transformer blocks.
        num_heads: Attention heads.
        image_size: Pixels along each side of an image.
        patch_size: Pixels along each side of the patch behind one token, a power of two.
        num_cameras: Images per observation.
        text_length: Word tokens per instruction.
        vocabulary_size: Number of words, special ones included.
    """

    width: int = 128
    num_layers: int = 2
    num_heads: int = 4
    image_size: int = 64
    patch_size: int = 16
    num_cameras: int = 3
    text_length: int = 10
    vocabulary_size: int = 2

    def __post_init__(self) -> None:
        problems = [
            f"{name} {value}" for name, value in asdict(self).items() if value < (name != "num_layers")
        ]
        if self.patch_size < 2 or self.patch_size & (self.patch_size - 1):
            problems.append(f"patch_size {self.patch_size} is not a power of two")
        elif self.image_size % self.patch_size:
            problems.append(f"image_size {self.image_size} is not a multiple of patch_size {self.patch_size}")
        if self.num_heads > 0 and self.width % self.num_heads:
            problems.append(f"width {self.width} is not a multiple of num_heads {self.num_heads}")
        if problems:
            raise CheckpointError(f"backbone_cfg: {'; '.join(problems)}")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "BackboneConfig":
        """Reads the sizes from a checkpoint's `backbone_cfg`.

        Raises:
            CheckpointError: sizes are missing, not integers, or contradict each other.
        """
        names = cls.__dataclass_fields__
        wrong = [name for name in names if type(values.get(name)) is not int]
        if wrong:
            raise CheckpointError(f"backbone_cfg: expected integers for {', '.join(wrong)}")
        return cls(**{name: values[name] for name in names})

    @property
    def stem_channels(self) -> tuple[int, ...]:
        """Output channels of each convolution: doubling, the last one the width."""
        stages = int(math.log2(self.patch_size))
        return (*(min(self.width, FIRST_CHANNELS << stage) for stage in range(stages - 1)), self.width)

    @property
    def tokens_per_camera(self) -> int:
        """Image tokens per image."""
        return (self.image_size // self.patch_size) ** 2

    @property
    def num_tokens(self) -> int:
        """T_vl: image tokens, camera by camera and row by row, then words, then the register."""
        return self.num_cameras * self.tokens_per_camera + self.text_length + 1

    def tensor_shapes(self) -> dict[str, tuple[int, ...]]:
        """Every tensor of the backbone; names are those of the torch module."""
        width = self.width
        shapes: dict[str, tuple[int, ...]] = {}
        channels = 3
        for stage, out_channels in enumerate(self.stem_channels):
            shapes[f"stem.{stage}.weight"] = (out_channels, channels, KERNEL, KERNEL)
            shapes[f"stem.{stage}.bias"] = (out_channels,)
            channels = out_channels
        shapes["image_position"] = (self.num_cameras, self.tokens_per_camera, width)
        shapes["word_embedding.weight"] = (self.vocabulary_size, width)
        shapes["word_position"] = (self.text_length, width)
        shapes["register"] = (1, width)
        for layer in range(self.num_layers):
            name = f"blocks.{layer}."
            for norm in ("norm1", "norm2"):
                shapes[f"{name}{norm}.weight"] = shapes[f"{name}{norm}.bias"] = (width,)
            for part, (out_features, in_features) in {
                "qkv": (3 * width, width),
                "out": (width, width),
                "up": (4 * width, width),
                "down": (width, 4 * width),
            }.items():
                shapes[f"{name}{part}.weight"] = (out_features, in_features)
                shapes[f"{name}{part}.bias"] = (out_features,)
        shapes["norm.weight"] = shapes["norm.bias"] = (width,)
        return shapes


class Backbone:
    """Images and words to tokens `(batch, T_vl, width)`.

    Args:
        config: its sizes.
        tensors: name to float32 array, names without prefix.

    Raises:
        CheckpointError: tensors are missing, unknown or of the wrong shape; lists all of them.

    Example:
        >>> from saccade.sim.policy import Policy
        >>> backbone = Policy.load().backbone
        >>> images = np.zeros((1, 3, 64, 64, 3), dtype=np.uint8)
        >>> features = backbone(images, np.zeros((1, backbone.config.text_length), dtype=np.int64))
        >>> features.shape == (1, backbone.config.num_tokens, 128)
        True
    """

    def __init__(self, config: BackboneConfig, tensors: Mapping[str, Float32Array]) -> None:
        expected = config.tensor_shapes()
        problems = [f"{name}: unknown" for name in tensors.keys() - expected.keys()]
        problems += [f"{name}: missing" for name in expected.keys() - tensors.keys()]
        problems += [
            f"{name}: shape {tensors[name].shape}, expected {shape}"
            for name, shape in expected.items()
            if name in tensors and tensors[name].shape != shape
        ]
        if problems:
            raise CheckpointError(f"backbone: {'; '.join(sorted(problems))}")
        self.config = config
        self._tensors = {name: np.ascontiguousarray(tensors[name], dtype=np.float32) for name in expected}
        self._kernels = [
            kernel_matrix(self._tensors[f"stem.{stage}.weight"]) for stage in range(len(config.stem_channels))
        ]

    def __call__(self, images: UInt8Array, word_numbers: npt.NDArray[np.int64]) -> Float32Array:
        """Runs the backbone.

        Args:
            images: `(batch, cameras, H, W, 3)` uint8.
            word_numbers: `(batch, text_length)`, from `Tokenizer`.

        Returns:
            `(batch, T_vl, width)` float32.

        Raises:
            ShapeError: sizes other than the config's.
        """
        config, tensors = self.config, self._tensors
        batch = images.shape[0]
        picture = (config.image_size, config.image_size, 3)
        if images.shape[1:] != (config.num_cameras, *picture):
            raise ShapeError(
                f"images: shape {images.shape}, expected (batch, {config.num_cameras}, *{picture})"
            )
        if word_numbers.shape != (batch, config.text_length):
            raise ShapeError(f"words: shape {word_numbers.shape}, expected {(batch, config.text_length)}")

        x = images.reshape(-1, *picture).astype(np.float32) / np.float32(127.5) - np.float32(1.0)
        for stage, kernel in enumerate(self._kernels):
            x = np.maximum(convolve(x, kernel, tensors[f"stem.{stage}.bias"]), 0.0)
        x = x.reshape(batch, config.num_cameras, config.tokens_per_camera, config.width)
        x = (x + tensors["image_position"]).reshape(batch, -1, config.width)  # (batch, image tokens, width)
        said = tensors["word_embedding.weight"][word_numbers] + tensors["word_position"]
        register = np.broadcast_to(tensors["register"], (batch, 1, config.width))
        x = np.concatenate((x, said, register), axis=1)  # (batch, T_vl, width)
        for layer in range(config.num_layers):
            x = self._block(x, f"blocks.{layer}.")
        return self._norm(x, "norm")

    def _block(self, x: Float32Array, name: str) -> Float32Array:
        """One pre-norm transformer block, `(batch, T_vl, width)` to the same."""
        x = x + self._linear(
            self._attend(self._linear(self._norm(x, f"{name}norm1"), f"{name}qkv")), f"{name}out"
        )
        hidden = gelu(self._linear(self._norm(x, f"{name}norm2"), f"{name}up"))
        return x + self._linear(hidden, f"{name}down")

    def _attend(self, qkv: Float32Array) -> Float32Array:
        """`(batch, T_vl, 3 width)` to `(batch, T_vl, width)`: every token reads every token."""
        batch, length, _ = qkv.shape
        heads = self.config.num_heads
        split = qkv.reshape(batch, length, 3, heads, -1)
        q, k, v = split.transpose(2, 0, 3, 1, 4)  # (batch, heads, T_vl, head_dim) each
        logits = q @ k.swapaxes(-1, -2) / math.sqrt(q.shape[-1])  # (batch, heads, T_vl, T_vl)
        weights = np.exp(logits - logits.max(axis=-1, keepdims=True))
        weights /= weights.sum(axis=-1, keepdims=True)
        joined: Float32Array = (weights @ v).transpose(0, 2, 1, 3).reshape(batch, length, -1)
        return joined

    def _linear(self, x: Float32Array, name: str) -> Float32Array:
        product: Float32Array = x @ self._tensors[f"{name}.weight"].T + self._tensors[f"{name}.bias"]
        return product

    def _norm(self, x: Float32Array, name: str) -> Float32Array:
        centred = x - x.mean(axis=-1, keepdims=True)
        variance = np.square(centred).mean(axis=-1, keepdims=True)
        scaled = centred / np.sqrt(variance + np.float32(NORM_EPS))
        normed: Float32Array = scaled * self._tensors[f"{name}.weight"] + self._tensors[f"{name}.bias"]
        return normed


def kernel_matrix(weight: Float32Array) -> Float32Array:
    """A convolution's weight `(out_channels, channels, 4, 4)` as the matrix `(16 * channels, out_channels)`.

    Channels are last in memory, as in the images, so that `convolve` copies contiguous runs.
    """
    return np.ascontiguousarray(weight.transpose(2, 3, 1, 0).reshape(-1, weight.shape[0]))


def convolve(x: Float32Array, kernel: Float32Array, bias: Float32Array) -> Float32Array:
    """A 4 x 4 convolution with stride 2 and padding 1, as one matrix product.

    Args:
        x: `(images, H, W, channels)`.
        kernel: `(16 * channels, out_channels)`, from `kernel_matrix`.
        bias: `(out_channels,)`.

    Returns:
        `(images, H / 2, W / 2, out_channels)`.
    """
    padded = np.pad(x, ((0, 0), (PADDING, PADDING), (PADDING, PADDING), (0, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (KERNEL, KERNEL), axis=(1, 2))
    windows = windows[:, ::STRIDE, ::STRIDE].transpose(
        0, 1, 2, 4, 5, 3
    )  # (images, H / 2, W / 2, 4, 4, channels)
    rows = windows.reshape(*windows.shape[:3], -1)  # (images, H / 2, W / 2, 16 * channels)
    return rows @ kernel + bias


def gelu(x: Float32Array) -> Float32Array:
    """GELU in its tanh form."""
    inner = math.sqrt(2.0 / math.pi) * (x + 0.044715 * x * x * x)
    return np.asarray(0.5 * x * (1.0 + np.tanh(inner)), dtype=np.float32)


def stack_images(images: Mapping[str, UInt8Array], cameras: Sequence[str]) -> UInt8Array:
    """The images of one observation in the policy's order, `(1, cameras, H, W, 3)`.

    Raises:
        ShapeError: a camera is missing.
    """
    missing = [name for name in cameras if name not in images]
    if missing:
        raise ShapeError(f"images: none of camera {', '.join(missing)}; there are {', '.join(images)}")
    return np.stack([images[name] for name in cameras])[None]
