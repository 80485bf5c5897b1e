"""The tokenizer of a checkpoint: its own, the released one in the cache of the Hub, or the one given."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import pytest

import saccade
from saccade._internal import hub_cache
from saccade._internal.tokenizers import tokenizer_path
from saccade.errors import CheckpointError
from tests.helpers.processor_cases import DATA, NOISE, TOKENIZER, assert_same, checkpoint

pytestmark = pytest.mark.usefixtures("cache")


def test_the_checkpoints_own_tokenizer(tmp_path: Path) -> None:
    source = checkpoint(tmp_path / "own", "n15_one_view")
    for folder in (source, source / "tokenizer", source / "processor"):
        folder.mkdir(exist_ok=True)
        shutil.copy(TOKENIZER, folder / "tokenizer.json")
        assert "tokens=443" in repr(saccade.Processor.from_pretrained(source))
        assert tokenizer_path(source) is None
        assert tokenizer_path(source, TOKENIZER) == TOKENIZER
        (folder / "tokenizer.json").unlink()


def in_cache(cache: Path, name: str, file: str = "tokenizer.json") -> Path:
    """A tokenizer in the cache, as `hf download` puts it there."""
    repository = cache / f"models--{name.replace('/', '--')}"
    snapshot = repository / "snapshots" / "4af2b622"
    snapshot.mkdir(parents=True)
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text("4af2b622")
    shutil.copy(TOKENIZER, snapshot / file)
    return snapshot


@pytest.mark.parametrize(
    ("fixture", "name"),
    [
        ("n15_one_view", "lerobot/eagle2hg-processor-groot-n1p5"),
        ("n16_two_views", "aravindhs-NV/eagle3-processor-groot-n1d6"),
        ("n16_two_views", "lerobot/eagle2hg-processor-groot-n1p5"),
        ("n17_one_view", "nvidia/Cosmos-Reason2-2B"),
        ("n17_one_view", "Qwen/Qwen3-VL-2B-Instruct"),
    ],
)
def test_the_released_tokenizer_in_the_cache(cache: Path, fixture: str, name: str) -> None:
    source = DATA / f"{fixture}.safetensors"
    with pytest.raises(FileNotFoundError, match="Download that of N1") as error:
        saccade.Processor.from_pretrained(source)
    assert f"hf download {name} " in str(error.value)
    assert "tokenizer=" in str(error.value)
    assert str(cache) in str(error.value)
    snapshot = in_cache(cache, name)
    assert "tokens=443" in repr(saccade.Processor.from_pretrained(source))
    assert hub_cache.folder_of(name, "main") == snapshot
    assert tokenizer_path(source) == tokenizer_path(source, name) == snapshot
    assert "tokens=443" in repr(saccade.Processor.from_pretrained(source, tokenizer=name))
    assert "tokens=443" in repr(saccade.Processor.from_pretrained(source, tokenizer=f"{name}@4af2b622"))
    (snapshot / "tokenizer.json").unlink()  # an incomplete download
    with pytest.raises(FileNotFoundError, match="Download that of N1"):
        saccade.Processor.from_pretrained(source)


def test_limits_of_the_released_processor(cache: Path) -> None:
    """N1.7's least area comes from the repository of its tokenizer."""
    snapshot = in_cache(cache, "nvidia/Cosmos-Reason2-2B")
    (snapshot / "preprocessor_config.json").write_text(json.dumps({"min_pixels": 4096}))
    source = DATA / "n17_one_view.safetensors"
    expected = saccade.Processor("n1.7", TOKENIZER, options={"min_pixels": 4096})
    assert_same(saccade.Processor.from_pretrained(source).frame(NOISE), expected.frame(NOISE))


def test_where_the_cache_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub.constants", None)
    for variable in ("HF_HUB_CACHE", "HUGGINGFACE_HUB_CACHE", "HF_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(variable, raising=False)
    for variable in ("HOME", "USERPROFILE"):  # that of Windows too
        monkeypatch.setenv(variable, str(tmp_path))
    assert hub_cache.cache() == tmp_path / ".cache" / "huggingface" / "hub"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert hub_cache.cache() == tmp_path / "xdg" / "huggingface" / "hub"
    monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
    assert hub_cache.cache() == tmp_path / "home" / "hub"
    monkeypatch.setenv("HF_HUB_CACHE", "~/cache")
    assert hub_cache.cache() == tmp_path / "cache"


@pytest.mark.parametrize("name", ["no-such.json", "../no/such", "./no/such"])
def test_no_such_tokenizer(name: str) -> None:
    with pytest.raises(FileNotFoundError, match="tokenizer: no such file or directory"):
        saccade.Processor("n1.5", name)


@pytest.mark.parametrize("name", ["no/such", "no/such@main"])
def test_no_such_published_tokenizer(name: str) -> None:
    with pytest.raises(FileNotFoundError, match=r"tokenizer: no/such: no such path.*hf download no/such"):
        saccade.Processor("n1.5", name)


def test_a_directory_without_a_tokenizer(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"holds neither tokenizer\.json nor vocab\.json and"):
        saccade.Processor("n1.5", tmp_path)
