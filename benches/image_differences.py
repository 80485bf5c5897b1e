"""How frames prepared by saccade differ from those of torch, Pillow and OpenCV, on random sizes.

`python -m benches.image_differences` prints a table: pixels compared, the share that differs, and by how many
levels of 255 at most. A library that is not installed is left out. The bits of torch's float32 path, and of
OpenCV, depend on the version and the machine that they were built for.
"""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

import saccade

Image = npt.NDArray[np.uint8]

TOKENIZER = Path(__file__).parents[1] / "tests" / "data" / "backbone" / "tiny_tokenizer.json"

#: Isaac-GR00T's and the later versions' options under which a frame reaches one resize alone.
AS_IT_IS = {"shortest_image_edge": None, "image_target_size": None, "crop_fraction": 1.0, "min_pixels": 1}


def levels(pixels: npt.NDArray[np.float32]) -> Image:
    """The bytes that normalised pixels were made of."""
    return cast("Image", np.rint(pixels * 127.5 + 127.5).astype(np.uint8))


def from_patches(pixels: npt.NDArray[np.float32], height: int, width: int) -> Image:
    """The image `(height, width, 3)` that N1.7's patches were cut from."""
    blocks = pixels.reshape(height // 32, width // 32, 2, 2, 3, 2, 16, 16)[:, :, :, :, :, 0]
    return levels(blocks.transpose(0, 2, 5, 1, 3, 6, 4).reshape(height, width, 3))


def images(count: int, seed: int, longest: int) -> Iterator[Image]:
    """Frames of random sizes: noise, smooth gradients, and flat areas with edges, in turn."""
    rng = np.random.default_rng(seed)
    for index in range(count):
        height, width = rng.integers(1, longest, 2)
        noise = rng.integers(0, 256, (height, width, 3))
        rows, columns = np.mgrid[:height, :width]
        phase = rng.uniform(0, 2 * np.pi, 3)
        waves = 127.5 + 127.5 * np.sin(rows[..., None] / 17 + columns[..., None] / 23 + phase)
        blocks = rng.integers(0, 256, (height // 16 + 1, width // 16 + 1, 3))
        flat = blocks.repeat(16, 0).repeat(16, 1)[:height, :width]
        yield np.asarray([noise, waves, flat][index % 3]).astype(np.uint8)


def torch_resize(image: npt.NDArray[Any], size: tuple[int, int], mode: str) -> npt.NDArray[Any]:
    """`torch.nn.functional.interpolate` with antialiasing, of `(height, width, 3)`."""
    import torch

    # Along the width and then along the height, planes apart, as torchvision gives it.
    planes = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None]
    resized = torch.nn.functional.interpolate(planes, size=size, mode=mode, antialias=True)
    found: npt.NDArray[Any] = resized[0].permute(1, 2, 0).numpy()
    return found


def torch_cubic(image: Image, rng: np.random.Generator) -> tuple[Image, Image]:
    """lerobot's N1.5: uint8, cubic."""
    size = int(rng.integers(8, 300))
    processor = saccade.Processor("n1.5", TOKENIZER, image_size=size, tokens_per_view=1)
    found = levels(processor.frame(image)).transpose(1, 2, 0)
    return found, torch_resize(image, (size, size), "bicubic")


def torch_linear_u8(image: Image, rng: np.random.Generator) -> tuple[Image, Image]:
    """Isaac-GR00T's N1.6 and N1.7 without albumentations: uint8, linear."""
    height, width = (32 * int(side) for side in rng.integers(1, 8, 2))
    options: dict[str, Any] = {"use_albumentations": False, "min_pixels": 1}
    options |= {"image_target_size": [height, width], "image_crop_size": [height, width]}
    found = saccade.Processor("n1.7", TOKENIZER, options=options).frame(image)
    return from_patches(found, height, width), torch_resize(image, (height, width), "bilinear")


def torch_linear(image: Image, rng: np.random.Generator) -> tuple[Image, Image]:
    """Isaac-GR00T's N1.5: float32, linear, truncated."""
    size = int(rng.integers(8, 300))
    processor = saccade.Processor(
        "n1.5",
        TOKENIZER,
        preprocessing="isaac",
        image_size=size,
        tokens_per_view=1,
        options={"crop_fraction": 1.0},
    )
    found = levels(processor.frame(image)).transpose(1, 2, 0)
    resized = torch_resize(image.astype(np.float32) / np.float32(255), (size, size), "bilinear")
    return found, (resized * np.float32(255)).astype(np.uint8)


def pillow_cubic(image: Image, _: np.random.Generator) -> tuple[Image, Image]:
    """N1.6: Pillow's cubic to multiples of 28."""
    from PIL import Image as Pillow

    pixels = saccade.Processor("n1.6", TOKENIZER, options=AS_IT_IS).frame(image)
    found = levels(pixels[0]).transpose(1, 2, 0)
    size = (found.shape[1], found.shape[0])
    return found, np.asarray(Pillow.fromarray(image).resize(size, Pillow.Resampling.BICUBIC))


def pillow_cubic_width_first(image: Image, _: np.random.Generator) -> tuple[Image, Image]:
    """The same with Pillow made to go along the width first, as it always did before Pillow 12."""
    from PIL import Image as Pillow

    pixels = saccade.Processor("n1.6", TOKENIZER, options=AS_IT_IS).frame(image)
    found = levels(pixels[0]).transpose(1, 2, 0)
    narrow = Pillow.fromarray(image).resize((found.shape[1], image.shape[0]), Pillow.Resampling.BICUBIC)
    return found, np.asarray(narrow.resize((found.shape[1], found.shape[0]), Pillow.Resampling.BICUBIC))


def opencv_area(image: Image, rng: np.random.Generator) -> tuple[Image, Image]:
    """N1.6 and N1.7: OpenCV's INTER_AREA, in one step to a size that nothing changes after it."""
    import cv2  # type: ignore[import-not-found]

    # A square part of the frame, so that both sides of the view are multiples of 32 and nothing changes it.
    edge = 32 * int(rng.integers(1, 8))
    side = min(image.shape[:2])
    square = np.ascontiguousarray(image[:side, :side])
    options = AS_IT_IS | {"shortest_image_edge": edge}
    found = saccade.Processor("n1.7", TOKENIZER, options=options).frame(square)
    expected = cv2.resize(square, (edge, edge), interpolation=cv2.INTER_AREA)
    return from_patches(found, edge, edge), expected


#: What is compared: the library, and how.
COMPARISONS: dict[str, tuple[str, Callable[[Image, np.random.Generator], tuple[Image, Image]]]] = {
    "torch uint8 cubic": ("torch", torch_cubic),
    "torch uint8 linear": ("torch", torch_linear_u8),
    "torch float32 linear": ("torch", torch_linear),
    "Pillow cubic": ("PIL", pillow_cubic),
    "Pillow cubic, width first": ("PIL", pillow_cubic_width_first),
    "OpenCV area": ("cv2", opencv_area),
}


def differences(name: str, count: int, seed: int, longest: int) -> npt.NDArray[np.int64]:
    """Number of values that differ by 0, 1, 2, ... levels."""
    library, compare = COMPARISONS[name]
    found = np.zeros(256, np.int64)
    if importlib.util.find_spec(library) is None:
        return found
    rng = np.random.default_rng(seed)
    for image in images(count, seed, longest):
        if max(image.shape[:2]) > 200 * min(image.shape[:2]):
            continue  # the released processors refuse it
        ours, theirs = compare(image, rng)
        assert ours.shape == theirs.shape
        found += np.bincount(np.abs(ours.astype(np.int64) - theirs).reshape(-1), minlength=256)
    return found


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=300, help="images of each comparison")
    parser.add_argument("--longest", type=int, default=700, help="longest side of an image")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print("| compared with | values | differ | most levels | differ by more than 1 |")
    print("|---|---|---|---|---|")
    for name, (library, _) in COMPARISONS.items():
        found = differences(name, arguments.images, arguments.seed, arguments.longest)
        if not found.any():
            print(f"| {name} | {library} is not installed | | | |")
            continue
        version = __import__(library).__version__
        total, most = found.sum(), int(np.flatnonzero(found).max())
        print(
            f"| {name} ({library} {version}) | {total:,} | {1 - found[0] / total:.2e} | {most} | "
            f"{found[2:].sum() / total:.2e} |"
        )


if __name__ == "__main__":
    main()
