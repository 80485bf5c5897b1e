"""Both kinds of tokenizer files, compared with Hugging Face's own reading, and hostile ones."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

import saccade
from saccade.errors import CheckpointError
from tests.helpers.processor_cases import TOKENIZER, assert_same

JSON: dict[str, Any] = json.loads(TOKENIZER.read_text())
PROCESSOR = saccade.Processor("n1.5", TOKENIZER)

TEXTS = [
    "open the drawer",
    "a <|im_end|> inside <think>",
    "naïve café 把红色 🤖 أفتح\r\n\n  x  ",
    "e\u0301 ﬁ \u00a0\u3000 1234 it's I'LL",
    "",
]


def write(folder: Path, value: Any) -> Path:
    path = folder / "tokenizer.json"
    path.write_text(value if isinstance(value, str) else json.dumps(value, ensure_ascii=False))
    return path


def slow(folder: Path) -> dict[str, Path]:
    """The same tokenizer as the files of repositories without a tokenizer.json."""
    model, added = JSON["model"], JSON["added_tokens"]
    flags = ("content", "lstrip", "normalized", "rstrip", "single_word", "special")
    texts = {
        "vocab.json": json.dumps(model["vocab"], ensure_ascii=False),
        "merges.txt": "#version: 0.2\n" + "\n".join(map(" ".join, model["merges"])) + "\n",
        "added_tokens.json": json.dumps({token["content"]: token["id"] for token in added}),
        "tokenizer_config.json": json.dumps(
            {
                "added_tokens_decoder": {str(one["id"]): {key: one[key] for key in flags} for one in added},
                "add_prefix_space": False,
            }
        ),
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    return {name: folder / name for name in texts}


@hypothesis.given(st.text(max_size=60))
def test_any_text_has_the_ids_of_hugging_face(text: str) -> None:
    """Another regular expression engine splits it there, and another table of Unicode."""
    from tokenizers import Tokenizer

    hypothesis.assume(not any("\ud800" <= letter <= "\udfff" for letter in text))
    expected = Tokenizer.from_file(str(TOKENIZER)).encode(text, add_special_tokens=False).ids
    assert_same(PROCESSOR.tokens(text), np.asarray(expected, np.int64))


def test_both_kinds_of_files_are_the_same_tokenizer(tmp_path: Path) -> None:
    files = slow(tmp_path)
    for left_out in (None, "tokenizer_config.json", "added_tokens.json"):
        if left_out is not None:
            slow(tmp_path)
            files[left_out].unlink()
        processor = saccade.Processor("n1.5", tmp_path)
        for text in TEXTS:
            assert_same(processor.tokens(text), PROCESSOR.tokens(text))


def test_merges_may_be_lines(tmp_path: Path) -> None:
    """As older files have them."""
    value = copy.deepcopy(JSON)
    value["model"]["merges"] = [" ".join(pair) for pair in JSON["model"]["merges"]]
    processor = saccade.Processor("n1.5", write(tmp_path, value))
    for text in TEXTS:
        assert_same(processor.tokens(text), PROCESSOR.tokens(text))


def test_added_tokens_keep_the_ids_of_the_file(tmp_path: Path) -> None:
    """Whatever their order, and with gaps between them."""
    value = copy.deepcopy(JSON)
    for token in value["added_tokens"]:
        token["id"] = 10_000 - 3 * token["id"]
    value["added_tokens"].reverse()
    processor = saccade.Processor("n1.5", write(tmp_path, value))
    assert processor.tokens("<|endoftext|><think>").tolist() == [10_000 - 3 * 406, 10_000 - 3 * 430]


def test_the_size_of_an_id_is_no_amount_of_memory(tmp_path: Path) -> None:
    value = copy.deepcopy(JSON)
    for huge, says in (
        ((1 << 24) - 1, None),
        (1 << 24, "below 16777216"),
        ((1 << 32) - 1, "below"),
        (1 << 32, ""),
    ):
        value["added_tokens"][-1]["id"] = huge
        if says is None:
            assert saccade.Processor("n1.5", write(tmp_path, value)).tokens("</interval>")[0] == huge
        else:
            with pytest.raises(CheckpointError, match=says):
                saccade.Processor("n1.5", write(tmp_path, value))


def change(path: str, value: Any) -> Callable[[dict[str, Any]], None]:
    """Sets the value at a path such as `model.vocab.!`."""
    *folders, last = path.split(".")

    def apply(whole: Any) -> None:
        for folder in folders:
            whole = whole[int(folder)] if isinstance(whole, list) else whole[folder]
        if isinstance(whole, list):
            whole[int(last)] = value
        else:
            whole[last] = value

    return apply


@pytest.mark.parametrize(
    ("path", "value", "says"),
    [
        ("model.type", "Unigram", "model.type: expected BPE, got Unigram"),
        ("model.type", "WordPiece", "model.type: expected BPE"),
        ("model.dropout", 0.1, "model.dropout: expected none"),
        ("model.unk_token", "<unk>", "model.unk_token: expected none"),
        ("model.continuing_subword_prefix", "##", "model.continuing_subword_prefix: expected none"),
        ("model.end_of_word_suffix", "</w>", "model.end_of_word_suffix: expected none"),
        ("model.byte_fallback", True, "model.byte_fallback: expected false"),
        ("model.ignore_merges", True, "model.ignore_merges: expected false"),
        ("truncation", {"max_length": 4}, "truncation: expected null"),
        ("padding", {"strategy": "BatchLongest"}, "padding: expected null"),
        ("normalizer", None, "normalizer: expected .*NFC"),
        ("normalizer", {"type": "Lowercase"}, "normalizer: expected .*NFC"),
        ("pre_tokenizer", {"type": "Whitespace"}, "pre_tokenizer: expected Qwen2's"),
        ("pre_tokenizer", None, "pre_tokenizer: expected Qwen2's"),
        ("pre_tokenizer.pretokenizers.0.pattern", {"Regex": "(a*)*b"}, "pre_tokenizer: expected Qwen2's"),
        ("pre_tokenizer.pretokenizers.1.add_prefix_space", True, "pre_tokenizer: expected Qwen2's"),
        ("post_processor", {"type": "TemplateProcessing"}, "post_processor: expected ByteLevel or none"),
        ("model.vocab", {}, "256 of the 256 byte tokens are missing"),
        ("model.vocab", [], "tokenizer"),
        ("model.vocab", {"a": -1}, "tokenizer"),
        ("model.vocab", {"a": 1.5}, "tokenizer"),
        ("model.vocab", {"a": "1"}, "tokenizer"),
        ("model.vocab.new", 7, "have the same id, 7"),
        ("model.merges", None, "tokenizer"),
        ("model.merges.3", ["no such", "token"], "3: .no such. is not in the vocabulary"),
        ("model.merges.3", ["", "a"], "3: expected two tokens"),
        ("model.merges.3", ["a"], "two tokens"),
        ("model.merges.3", ["a", "b", "c"], "two tokens"),
        ("model.merges.3", "a b c", "two tokens"),
        ("model.merges.3", "ab", "two tokens"),
        ("model.merges.3", 5, "two tokens"),
        ("model.merges.3", JSON["model"]["merges"][2], "3: .* appears twice"),
        ("added_tokens", [], "special tokens of N1.5 are missing: <|endoftext|>"),
        ("added_tokens", {}, "tokenizer"),
        ("added_tokens.0.content", "", "is empty"),
        ("added_tokens.0.content", "<img>", "added twice"),
        ("added_tokens.0.id", 407, "have the same id, 407"),
        ("added_tokens.0.id", None, "tokenizer"),
        ("added_tokens.0.id", -1, "tokenizer"),
        ("added_tokens.0.content", "!", "expected the id of the vocabulary"),
        ("model", None, "tokenizer"),
    ],
)
def test_files_that_are_refused(tmp_path: Path, path: str, value: Any, says: str) -> None:
    broken = copy.deepcopy(JSON)
    change(path, value)(broken)
    with pytest.raises(CheckpointError, match=says.replace("|", r"\|") if "<|" in says else says):
        saccade.Processor("n1.5", write(tmp_path, broken))


def test_everything_that_is_wrong_is_listed(tmp_path: Path) -> None:
    broken = copy.deepcopy(JSON)
    for path, value in (("model.dropout", 1.0), ("normalizer", None), ("padding", {})):
        change(path, value)(broken)
    with pytest.raises(CheckpointError) as error:
        saccade.Processor("n1.5", write(tmp_path, broken))
    assert all(key in str(error.value) for key in ("model.dropout", "normalizer", "padding"))
    broken = copy.deepcopy(JSON)
    broken["model"]["merges"] = [["no", str(index)] for index in range(1000)]
    with pytest.raises(CheckpointError) as error:
        saccade.Processor("n1.5", write(tmp_path, broken))
    assert re.search(r"and \d{4} more", str(error.value))
    assert len(str(error.value)) < 3000


def test_merges_in_a_circle_end(tmp_path: Path) -> None:
    """A merge is one token longer than its parts, whatever a file makes of it."""
    from tokenizers import Tokenizer

    value = copy.deepcopy(JSON)
    value["model"]["vocab"] |= {"aa": 9000, "aaa": 9001, "aaaa": 9002}
    value["model"]["merges"] = [["aa", "aa"], ["aa", "a"], ["a", "aa"], ["a", "a"]]
    path = write(tmp_path, value)
    text = "a" * 200_000
    expected = Tokenizer.from_file(str(path)).encode(text, add_special_tokens=False).ids
    assert_same(saccade.Processor("n1.5", path).tokens(text), np.asarray(expected))


@pytest.mark.parametrize("where", [0, 1, 10, 1000, 20_000, -1])
def test_files_that_are_cut_off(tmp_path: Path, where: int) -> None:
    with pytest.raises(CheckpointError, match=r"tokenizer: .*tokenizer\.json: not valid JSON"):
        saccade.Processor("n1.5", write(tmp_path, TOKENIZER.read_text().rstrip()[:where]))


@pytest.mark.parametrize(
    "text", ["[]", "7", "null", '"a"', "{}", "[" * 100_000, '{"model": {"vocab": {"a": 1, "a": 2}}}']
)
def test_other_json(tmp_path: Path, text: str) -> None:
    with pytest.raises(CheckpointError, match="tokenizer"):
        saccade.Processor("n1.5", write(tmp_path, text))


def test_files_that_are_no_text(tmp_path: Path) -> None:
    (tmp_path / "tokenizer.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CheckpointError, match="tokenizer"):
        saccade.Processor("n1.5", tmp_path)
    (tmp_path / "folder" / "tokenizer.json").mkdir(parents=True)
    with pytest.raises(CheckpointError, match="tokenizer"):
        saccade.Processor("n1.5", tmp_path / "folder")


@pytest.mark.parametrize(
    ("file", "text", "says"),
    [
        ("vocab.json", "{", "vocab.json"),
        ("vocab.json", '{"a": 1, "a": 2}', "appears twice"),
        ("merges.txt", "a b c\n", "line 1: expected two tokens"),
        ("merges.txt", "#version: 0.2\n\nab\n", "line 3: expected two tokens"),
        ("merges.txt", "a \ue000\n", "is not in the vocabulary"),
        ("added_tokens.json", "[]", "added_tokens.json"),
        ("added_tokens.json", '{"<|endoftext|>": 407}', "407 is .* in added_tokens.json and"),
        ("tokenizer_config.json", '{"added_tokens_decoder": {"x": {"content": "y"}}}', "expected an id"),
        ("tokenizer_config.json", '{"add_prefix_space": true}', "add_prefix_space: expected false"),
        ("tokenizer_config.json", '{"add_bos_token": true}', "add_bos_token: expected false"),
        ("tokenizer_config.json", "null", "tokenizer_config.json"),
    ],
)
def test_slow_files_that_are_refused(tmp_path: Path, file: str, text: str, says: str) -> None:
    slow(tmp_path)[file].write_text(text)
    with pytest.raises(CheckpointError, match=says):
        saccade.Processor("n1.5", tmp_path)
