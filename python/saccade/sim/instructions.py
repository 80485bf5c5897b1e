"""Tokenization: a small vocabulary of whole words."""

import re
from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

PAD, UNKNOWN = "<pad>", "<unknown>"


def words(instruction: str) -> list[str]:
    """The words of an instruction in lower case, without punctuation.

    Example:
        >>> words("Open the drawer, please!")
        ['open', 'the', 'drawer', 'please']
    """
    return re.findall(r"[a-z0-9]+", instruction.lower())


def build_vocabulary(instructions: Iterable[str]) -> tuple[str, ...]:
    """Every word of the instructions, sorted, after the two special entries."""
    return (PAD, UNKNOWN, *sorted({word for instruction in instructions for word in words(instruction)}))


class Tokenizer:
    """Maps an instruction to a fixed number of word indices.

    Padding tokens are attended to like any other token: the head ignores padding masks, as the released one
    does. With a fixed length, training and inference see the same number of them.

    Args:
        vocabulary: the result of `build_vocabulary`.
        length: tokens per instruction; longer instructions are truncated.
    """

    def __init__(self, vocabulary: Sequence[str], length: int) -> None:
        self.length = length
        self._number = {word: number for number, word in enumerate(vocabulary)}

    def __call__(self, instruction: str) -> npt.NDArray[np.int64]:
        """Word indices `(length,)`; 0 is padding, 1 a word outside the vocabulary."""
        numbers = [self._number.get(word, 1) for word in words(instruction)][: self.length]
        return np.array(numbers + [0] * (self.length - len(numbers)), dtype=np.int64)
