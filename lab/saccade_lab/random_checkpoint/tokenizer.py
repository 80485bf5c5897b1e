"""A small tokenizer with the published special tokens, for random checkpoints and small policies.

Its vocabulary are the 256 bytes, the words of the released prompts and a few more. With the published ids,
prompts of these words have exactly the ids of the published tokenizer; other text is spelled in bytes.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from saccade.errors import InputError

_VOCABULARY = json.loads(Path(__file__).with_name("vocabulary.json").read_text(encoding="utf-8"))

#: Words as byte-level BPE spells them ("Ġ" is a space), and their published ids.
WORDS: Mapping[str, int] = _VOCABULARY["words"]

#: The added tokens in the order of their ids, and whether they are special.
ADDED: Mapping[str, bool] = _VOCABULARY["added"]

#: The id of the first added token in the published vocabulary.
FIRST_ADDED = 151643

PATTERN = (
    r"(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}| ?[^\s\p{L}\p{N}]+[\r\n]*"
    r"|\s*[\r\n]+|\s+(?!\S)|\s+"
)


def tokenizer(*, published_ids: bool, words: Sequence[str] = ()) -> dict[str, Any]:
    """The content of ``tokenizer.json``.

    Args:
        published_ids: Whether tokens have their published ids, for a table of 151680 rows. Otherwise the ids
            have no gaps; without ``words`` there are fewer than 512.
        words: Words that are one token each, at the beginning of a text and after a space, in addition to
            ``WORDS``. Only without published ids.

    Raises:
        InputError: ``words`` are given with published ids.
    """
    if published_ids and words:
        raise InputError("words: expected none with published_ids, which have no place for them")
    known = [word for spelled in words for word in (f"Ġ{spelled}", spelled)]
    known = list(dict.fromkeys((*WORDS, *known)))
    merges, parts = _merges(known)
    vocabulary = {character: index for index, character in enumerate(_alphabet())}
    if published_ids:
        vocabulary |= WORDS
        # Parts of words never remain, so any free id will do.
        free = range(FIRST_ADDED - len(parts), FIRST_ADDED)
        vocabulary |= dict(zip(parts, free, strict=True))
        first = FIRST_ADDED
    else:
        for token in (*known, *parts):
            vocabulary.setdefault(token, len(vocabulary))  # a word may be a single character
        first = len(vocabulary)
    ids = {token: first + index for index, token in enumerate(ADDED)}
    added = [
        {
            "id": ids[token],
            "content": token,
            "single_word": False,
            "lstrip": False,
            "rstrip": False,
            "normalized": False,
            "special": special,
        }
        for token, special in ADDED.items()
    ]
    byte_level = {"type": "ByteLevel", "add_prefix_space": False, "trim_offsets": False, "use_regex": False}
    split = {"type": "Split", "pattern": {"Regex": PATTERN}, "behavior": "Isolated", "invert": False}
    return {
        "version": "1.0",
        "truncation": None,
        "padding": None,
        "added_tokens": added,
        "normalizer": {"type": "NFC"},
        "pre_tokenizer": {"type": "Sequence", "pretokenizers": [split, byte_level]},
        "post_processor": None,
        "decoder": byte_level,
        "model": {
            "type": "BPE",
            "dropout": None,
            "unk_token": None,
            "continuing_subword_prefix": "",
            "end_of_word_suffix": "",
            "fuse_unk": False,
            "byte_fallback": False,
            "ignore_merges": False,
            # The added tokens are in the model too: a tokenizer numbers those that are not from its end.
            "vocab": vocabulary | ids,
            "merges": merges,
        },
    }


def token_id(token: str, *, published_ids: bool, words: Sequence[str] = ()) -> int:
    """The id of a token of :func:`tokenizer`.

    Example:
        >>> token_id("<IMG_CONTEXT>", published_ids=True)
        151669
    """
    return int(tokenizer(published_ids=published_ids, words=words)["model"]["vocab"][token])


def _merges(words: Iterable[str]) -> tuple[list[str], list[str]]:
    """Merges that make each word one token, and the parts that are no words themselves.

    A word is spelled with the merges of the words before it, and what remains is joined from the left. Later
    merges do not change how an earlier word is spelled, because the earliest merge always comes first.
    """
    ranks: dict[tuple[str, str], int] = {}
    parts: dict[str, None] = {}
    wanted = list(words)
    for word in wanted:
        spelled = _spelled(word, ranks)
        while len(spelled) > 1:
            ranks[spelled[0], spelled[1]] = len(ranks)
            spelled = [spelled[0] + spelled[1], *spelled[2:]]
            parts[spelled[0]] = None
    return [" ".join(pair) for pair in ranks], [part for part in parts if part not in wanted]


def _spelled(word: str, ranks: Mapping[tuple[str, str], int]) -> list[str]:
    """The tokens of a word: byte-pair encoding."""
    tokens = list(word)
    while pairs := [pair for pair in pairwise(tokens) if pair in ranks]:
        first = min(pairs, key=lambda pair: ranks[pair])
        joined: list[str] = []
        while tokens:
            length = 2 if tuple(tokens[:2]) == first else 1
            joined.append("".join(tokens[:length]))
            tokens = tokens[length:]
        tokens = joined
    return tokens


def _alphabet() -> list[str]:
    """The character of each byte in the order of the published vocabulary; printable ones are themselves."""
    printable = [*range(ord("!"), ord("~") + 1), *range(0xA1, 0xAC + 1), *range(0xAE, 0xFF + 1)]
    others = 256 - len(printable)
    return [chr(code) for code in printable] + [chr(256 + index) for index in range(others)]
