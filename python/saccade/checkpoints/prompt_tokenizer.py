"""A small tokenizer with the published special tokens, for random checkpoints.

Its vocabulary are the 256 bytes, the words of the released prompts and a few more. With the published ids,
prompts of these words have exactly the ids of the published tokenizer; other text is spelled in bytes.
"""

from __future__ import annotations

from typing import Any

#: Words as byte-level BPE spells them ("Ġ" is a space), and their published ids.
WORDS = {
    "Ġa": 264,
    "Ġare": 525,
    "Ġand": 323,
    "Ġassistant": 17847,
    "Ġhelpful": 10950,
    "Ġthe": 279,
    "Ġit": 432,
    "Ġdrawer": 26482,
    "Ġdrop": 5943,
    "Ġdon": 1513,
    "Ġup": 705,
    "Ġred": 2518,
    "Ġblock": 2504,
    "You": 2610,
    "system": 8948,
    "assistant": 77091,
    "push": 9077,
    "user": 872,
    "image": 1805,
    "open": 2508,
    "Pick": 36953,
    "'t": 944,
    "['": 677,
    "']": 660,
    '["': 1183,
    '"]': 1341,
    "Ġg": 342,
}

#: The added tokens in the order of their ids, and whether they are special.
ADDED = {
    **dict.fromkeys(
        (
            "<|endoftext|>",
            "<|im_start|>",
            "<|im_end|>",
            "<|object_ref_start|>",
            "<|object_ref_end|>",
            "<|box_start|>",
            "<|box_end|>",
            "<|quad_start|>",
            "<|quad_end|>",
            "<|vision_start|>",
            "<|vision_end|>",
            "<|vision_pad|>",
            "<|image_pad|>",
            "<|video_pad|>",
        ),
        True,
    ),
    **dict.fromkeys(
        (
            "<tool_call>",
            "</tool_call>",
            "<|fim_prefix|>",
            "<|fim_middle|>",
            "<|fim_suffix|>",
            "<|fim_pad|>",
            "<|repo_name|>",
            "<|file_sep|>",
            "<tool_response>",
            "</tool_response>",
            "<think>",
            "</think>",
        ),
        False,
    ),
    **dict.fromkeys(
        (
            "<IMG_CONTEXT>",
            "<img>",
            "</img>",
            "<box>",
            "</box>",
            "<quad>",
            "</quad>",
            "<ref>",
            "</ref>",
            "<interval>",
            "</interval>",
        ),
        True,
    ),
}

#: The id of the first added token in the published vocabulary.
FIRST_ADDED = 151643

PATTERN = (
    r"(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}| ?[^\s\p{L}\p{N}]+[\r\n]*"
    r"|\s*[\r\n]+|\s+(?!\S)|\s+"
)


def tokenizer(*, published_ids: bool) -> dict[str, Any]:
    """The content of ``tokenizer.json``.

    Args:
        published_ids: whether tokens have their published ids, for a table of 151680 rows. Otherwise the ids
            have no gaps: there are fewer than 512.
    """
    merges, parts = _merges()
    vocabulary = {character: index for index, character in enumerate(_alphabet())}
    if published_ids:
        vocabulary |= WORDS
        # Parts of words never remain, so any free id will do.
        free = range(FIRST_ADDED - len(parts), FIRST_ADDED)
        vocabulary |= dict(zip(parts, free, strict=True))
        first = FIRST_ADDED
    else:
        for token in (*WORDS, *parts):
            vocabulary[token] = len(vocabulary)
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


def token_id(token: str, *, published_ids: bool) -> int:
    """The id of a token.

    Example:
        >>> token_id("<IMG_CONTEXT>", published_ids=True)
        151669
    """
    return int(tokenizer(published_ids=published_ids)["model"]["vocab"][token])


def _merges() -> tuple[list[str], list[str]]:
    """The merges that spell each word from the left, and the parts that are no words themselves."""
    merges: dict[str, None] = {}
    parts: dict[str, None] = {}
    for word in WORDS:
        for end in range(1, len(word)):
            merges[f"{word[:end]} {word[end]}"] = None
            if word[: end + 1] not in WORDS:
                parts[word[: end + 1]] = None
    return list(merges), list(parts)


def _alphabet() -> list[str]:
    """The character of each byte in the order of the published vocabulary; printable ones are themselves."""
    printable = [*range(ord("!"), ord("~") + 1), *range(0xA1, 0xAC + 1), *range(0xAE, 0xFF + 1)]
    others = 256 - len(printable)
    return [chr(code) for code in printable] + [chr(256 + index) for index in range(others)]
