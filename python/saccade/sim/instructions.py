"""Words to numbers: a small vocabulary of whole words."""

import re
from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

PAD, UNKNOWN = "<pad>", "<unknown>"


def words(instruction: str) -> list[str]:
    """Lower-case words without punctuation.

    Example:
        >>> words("Open the drawer, please!")
        ['open', 'the', 'drawer', 'please']
    """
    return re.findall(r"[a-z0-9]+", instruction.lower())


def build_vocabulary(instructions: Iterable[str]) -> tuple[str, ...]:
    """Every word of the instructions, sorted, after the two special entries."""
    return (PAD, UNKNOWN, *sorted({word for instruction in instructions for word in words(instruction)}))


class Tokenizer:
    """Maps an instruction to a fixed number of word numbers.

    Padding tokens are tokens like any other: the head ignores masks as the released one does, and with a
    fixed length it sees the same in training and at run time.

    Args:
        vocabulary: from `build_vocabulary`.
        length: tokens of every instruction; what is longer is cut off.
    """

    def __init__(self, vocabulary: Sequence[str], length: int) -> None:
        self.length = length
        self._number = {word: number for number, word in enumerate(vocabulary)}

    def __call__(self, instruction: str) -> npt.NDArray[np.int64]:
        """Word numbers `(length,)`; 0 pads, 1 stands for a word that is not in the vocabulary."""
        numbers = [self._number.get(word, 1) for word in words(instruction)][: self.length]
        return np.array(numbers + [0] * (self.length - len(numbers)), dtype=np.int64)
