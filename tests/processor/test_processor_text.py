"""Instructions as Python's own functions treat them, for every character."""

from __future__ import annotations

import re
import sys
import unicodedata
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import hypothesis
import numpy as np
import pytest
import tokenizers
from hypothesis import strategies as st

import saccade
from tests.helpers.processor_cases import BLACK, TOKENIZER

N15 = saccade.Processor("n1.5", TOKENIZER, image_size=14)
N17 = saccade.Processor("n1.7", TOKENIZER, options={"shortest_image_edge": 64, "min_pixels": 4096})
SMALL = BLACK[:14, :14]


def as_a_list(text: str) -> tuple[list[int], list[int]]:
    """The ids of a prompt, and those that Python's `str([text])` makes."""
    prompt = (
        "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n<|im_start|>user\n<image 1><img>"
        f"<IMG_CONTEXT></img>{[text]!s}<|im_end|>\n<|im_start|>assistant\n"
    )
    return N15([SMALL], text).input_ids[0].tolist(), N15.tokens(prompt).tolist()


def formalized(text: str) -> tuple[list[int], list[int]]:
    """The same for N1.7, whose text Python lowers and strips of punctuation."""
    words = re.sub(r"[^\w\s]", "", text.lower())
    view = "<|vision_start|><|image_pad|><|image_pad|><|image_pad|><|image_pad|><|vision_end|>"
    prompt = f"<|im_start|>user\n{view}{words}<|im_end|>\n"
    return N17([BLACK], text).input_ids[0].tolist(), N17.tokens(prompt).tolist()


def characters() -> list[str]:
    """Every character that this Python's Unicode has a name or a category for."""
    letters = map(chr, range(sys.maxunicode + 1))
    kinds = ("Cn", "Cs", "Co")  # not assigned, surrogates, private use
    return [letter for letter in letters if unicodedata.category(letter) not in kinds]


@pytest.mark.parametrize("render", [as_a_list, formalized])
def test_every_character(render: Callable[[str], tuple[list[int], list[int]]]) -> None:
    every = characters()
    # Han, Hangul and the like are alike: a part of them will do.
    chosen = [letter for index, letter in enumerate(every) if ord(letter) < 0x3400 or index % 37 == 0]
    for start in range(0, len(chosen), 512):
        text = "x".join(chosen[start : start + 512])
        found, expected = render(text)
        assert found == expected, f"between U+{ord(text[0]):04X} and U+{ord(text[-1]):04X}"


@hypothesis.given(st.text(alphabet=st.characters(max_codepoint=0x500, exclude_categories=["Cs", "Cn"])))
def test_any_text(text: str) -> None:
    hypothesis.assume(text)
    for found, expected in (as_a_list(text), formalized(text)):
        assert found == expected


@pytest.mark.parametrize("text", ["ΑΣ", "ΑΣ Σ", "ΣΑ", "Α.Σ", "ΑΣ\u0345", "AΣB", "İI", "ß ẞ", "Ǆ ǅ"])  # noqa: RUF001
def test_letters_whose_lower_case_depends_on_others(text: str) -> None:
    found, expected = formalized(text)
    assert found == expected


@pytest.mark.parametrize(
    "text", ["'", '"', "\"'", "\\'", "a\tb\r\n", "\x00\x7f\x85\xad", "\U000e0001", "\u2028"]
)
def test_quotes_and_escapes(text: str) -> None:
    found, expected = as_a_list(text)
    assert found == expected
    assert np.asarray(found).size


@pytest.mark.parametrize("processor", [N15, N17])
def test_texts_are_those_of_the_package(processor: saccade.Processor) -> None:
    package = tokenizers.Tokenizer.from_file(str(TOKENIZER))
    ids = list(package.get_vocab(with_added_tokens=True).values())
    expected = [package.decode([one], skip_special_tokens=False) for one in ids]
    assert processor.texts(ids) == expected


def test_texts_that_come_again_have_the_ids_of_the_crate() -> None:
    """Ids of the last texts are kept: more texts than that, a long one, and several threads."""
    crate = tokenizers.Tokenizer.from_file(str(TOKENIZER))
    texts = [f"open drawer {number}" for number in range(40)] + ["close it " * 3000]
    expected = {text: crate.encode(text, add_special_tokens=False).ids for text in texts}
    processor = saccade.Processor("n1.5", TOKENIZER, image_size=14)
    asked = [text for text in texts for _ in range(2)] + texts[::-1] + texts[:3] * 20

    def check(start: int) -> bool:
        return all(
            processor.tokens(text).tolist() == expected[text] for text in asked[start:] + asked[:start]
        )

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(check, range(0, 40, 10)))
