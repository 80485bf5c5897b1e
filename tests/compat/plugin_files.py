"""The plugin's policies as files: saved, loaded, published. `make test-compat` runs this after plugin.py."""

# lerobot has no types.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any
from unittest import mock

import plugin_cases
import pytest
import torch
from huggingface_hub import errors
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import make_policy, make_pre_post_processors

from lerobot_policy_saccade import SaccadeConfig, SaccadeEnv, files
from lerobot_policy_saccade.modeling_saccade import SaccadePolicy

# Fixtures.
checkpoint, policy, batch = plugin_cases.checkpoint, plugin_cases.policy, plugin_cases.batch


def test_saved_and_loaded(
    policy: SaccadePolicy, batch: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    policy.save_pretrained(Path("first"))
    policy.save_pretrained(Path("first"))  # replaces it
    assert not [path for path in Path("first").rglob("*") if path.suffix == ".pt" or path.name[0] == "."]
    shutil.move("first", "moved")
    loaded = SaccadePolicy.from_pretrained("moved", config=None)
    assert loaded.config.checkpoint == str(Path("moved", "checkpoint"))
    loaded.save_pretrained("moved")  # onto itself
    policy.reset()
    expected = policy.predict_action_chunk(batch)

    # As `lerobot-eval --policy.path=moved --policy.n_action_steps=2 --rename_map=...` does.
    config = PreTrainedConfig.from_pretrained("moved", cli_overrides=["--n_action_steps=2"])
    assert (config.checkpoint, config.seed, config.n_action_steps) == (None, 7, 2)
    config.pretrained_path = Path("moved")
    again = make_policy(config, env_cfg=SaccadeEnv())
    before, after = make_pre_post_processors(
        policy_cfg=config,
        pretrained_path=config.pretrained_path,
        preprocessor_overrides={
            "device_processor": {"device": "cpu"},
            "rename_observations_processor": {
                "rename_map": {"observation.images.up": "observation.images.top"}
            },
        },
    )
    batch["observation.images.up"] = batch.pop("observation.images.top")
    actions = [after(again.select_action(before(dict(batch)))) for _ in range(2)]
    assert torch.equal(torch.stack(actions, 1), expected[:, :2])


def data_config_file(path: Path) -> Path:
    """A data config of the checkpoint, with its keys and cameras in another order."""
    kinds = {"video": ("top", "left", "right"), "state": ("gripper", "hand"), "action": ("gripper", "hand")}
    keys = {f"{kind}_keys": [f"{kind}.{name}" for name in names] for kind, names in kinds.items()}
    modes = {f"{kind}_modes": dict.fromkeys(keys[f"{kind}_keys"], "min_max") for kind in ("state", "action")}
    config = {
        **keys,
        **modes,
        "language_keys": ["annotation.human.task_description"],
        "observation_indices": [0],
        "action_indices": list(range(8)),
        "target_rotations": {},
    }
    path.write_text(json.dumps(config))
    return path


def test_a_saved_policy_has_its_data_config(
    checkpoint: Path, policy: SaccadePolicy, batch: dict[str, Any], tmp_path: Path
) -> None:
    given = data_config_file(tmp_path / "mine.json")
    config = SaccadeConfig(checkpoint=str(checkpoint), num_threads=1, seed=7, data_config=str(given))
    saved = SaccadePolicy(config)
    expected = saved.predict_action_chunk(batch)
    assert expected.shape == (3, 8, 4)
    for _ in range(2):
        saved.save_pretrained(tmp_path / "saved")
    given.unlink()
    assert PreTrainedConfig.from_pretrained(tmp_path / "saved").data_config is None
    loaded = SaccadePolicy.from_pretrained(tmp_path / "saved")
    assert torch.equal(loaded.predict_action_chunk(batch), expected)
    loaded.save_pretrained(tmp_path / "saved")  # onto itself
    assert SaccadePolicy.from_pretrained(tmp_path / "saved").config.data_config is not None
    # One without leaves none behind.
    policy.save_pretrained(tmp_path / "saved")
    assert not (tmp_path / "saved" / "data_config").exists()


def test_options_that_saccade_reads(checkpoint: Path, policy: SaccadePolicy, tmp_path: Path) -> None:
    """They are given, saved and overridden as lerobot's programs do, and reach the policy."""
    policy.save_pretrained(tmp_path)
    arguments = [
        '--processor_options={"letter_box_transform": true}',
        "--action_horizon=8",
        "--data_config=a.json",
    ]
    config = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=arguments)
    given = {
        "processor_options": {"letter_box_transform": True},
        "action_horizon": 8,
        "data_config": "a.json",
    }
    assert {name: getattr(config, name) for name in given} == given
    config._save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path).processor_options == given["processor_options"]
    with (
        mock.patch("saccade.Policy.from_pretrained", side_effect=RuntimeError("called")) as load,
        pytest.raises(RuntimeError, match="called"),
    ):
        SaccadePolicy.from_pretrained(checkpoint, config=config)
    assert {name: load.call_args.kwargs[name] for name in given} == given


def without_tokenizer(checkpoint: Path, folder: Path) -> tuple[Path, Path]:
    """A checkpoint without a tokenizer, as the released ones, and its tokenizer, under another name."""
    shutil.copytree(checkpoint, folder / "bare")
    (folder / "bare" / "tokenizer.json").rename(folder / "words.json")
    return folder / "bare", folder / "words.json"


@pytest.mark.parametrize("where", ["file", "directory", "cache"])
def test_a_saved_policy_has_its_tokenizer(
    checkpoint: Path,
    policy: SaccadePolicy,
    batch: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    where: str,
) -> None:
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "cache"))
    bare, words = without_tokenizer(checkpoint, tmp_path)
    given: str | None = str(words)
    if where == "directory":
        folder = tmp_path / "words"
        folder.mkdir()
        shutil.copy(words, folder / "tokenizer.json")
        (folder / "model.bin").write_bytes(b"large")
        given = str(folder)
    if where == "cache":
        given = None
        snapshots = tmp_path / "cache" / "models--lerobot--eagle2hg-processor-groot-n1p5" / "snapshots"
        (snapshots / "main").mkdir(parents=True)
        shutil.copy(words, snapshots / "main" / "tokenizer.json")
    config = SaccadeConfig(checkpoint=str(bare), tokenizer=given, num_threads=1, seed=7)
    saved = SaccadePolicy(config)
    for _ in range(2):
        saved.save_pretrained(tmp_path / "saved")
    # To another machine.
    shutil.move(tmp_path / "saved", tmp_path / "elsewhere")
    for path in (bare, words.parent / "words", tmp_path / "cache"):
        shutil.rmtree(path, ignore_errors=True)
    words.unlink()
    assert PreTrainedConfig.from_pretrained(tmp_path / "elsewhere").tokenizer is None
    folder = tmp_path / "elsewhere" / "tokenizer"
    assert [path.name for path in folder.iterdir()] == ["tokenizer.json"]
    loaded = SaccadePolicy.from_pretrained(tmp_path / "elsewhere")
    policy.reset()
    expected = policy.predict_action_chunk(batch)
    assert torch.equal(loaded.predict_action_chunk(batch), expected)
    loaded.save_pretrained(tmp_path / "elsewhere")  # onto itself
    loaded.save_pretrained(tmp_path / "again")
    again = SaccadePolicy.from_pretrained(tmp_path / "again")
    assert torch.equal(again.predict_action_chunk(batch), expected)
    # One with a tokenizer of its own leaves none behind.
    policy.save_pretrained(tmp_path / "again")
    assert not (tmp_path / "again" / "tokenizer").exists()


@pytest.mark.parametrize("fails", ["copyfile", "rename"])
def test_a_full_disk_keeps_what_was_saved(
    checkpoint: Path, policy: SaccadePolicy, tmp_path: Path, fails: str
) -> None:
    bare, words = without_tokenizer(checkpoint, tmp_path)
    saved = tmp_path / "saved"
    SaccadePolicy(SaccadeConfig(checkpoint=str(bare), tokenizer=str(words))).save_pretrained(saved)

    def found() -> dict[Path, int]:
        files = [path for name in ("checkpoint", "tokenizer") for path in (saved / name).rglob("*")]
        return {path: path.stat().st_mtime_ns for path in files}

    held, rename = found(), Path.rename

    def last_fails(path: Path, target: Path) -> Path:
        if path == saved / "tokenizer":
            raise OSError(28, "full")
        return rename(path, target)

    failing = (
        mock.patch("shutil.copyfile", side_effect=OSError(28, "full"))
        if fails == "copyfile"
        else mock.patch.object(Path, "rename", last_fails)
    )
    with failing, pytest.raises(OSError):
        policy.save_pretrained(saved)
    assert found() == held
    assert not list(saved.glob(".*"))


def cached(checkpoint: Path, cache: Path, commit: str) -> None:
    """Puts a repository into a cache as `huggingface_hub` lays it out, with the branch `trained`."""
    repository = cache / "models--owner--robot"
    shutil.copytree(checkpoint, repository / "snapshots" / commit)
    (repository / "refs").mkdir()
    (repository / "refs" / "trained").write_text(commit)


def test_published_repositories(
    checkpoint: Path, policy: SaccadePolicy, batch: dict[str, Any], tmp_path: Path
) -> None:
    commit = "0123456789abcdef0123456789abcdef01234567"
    cached(checkpoint, tmp_path, commit)
    policy.reset()
    expected = policy.predict_action_chunk(batch)
    here: dict[str, Any] = {"cache_dir": tmp_path, "local_files_only": True}
    for name, revision in (
        ("owner/robot", "trained"),
        ("owner/robot", commit),
        ("owner/robot@trained", None),
    ):
        # A checkpoint that this class did not save, with options instead of a config.
        loaded = SaccadePolicy.from_pretrained(name, revision=revision, **here, num_threads=1, seed=7)
        assert torch.equal(loaded.predict_action_chunk(batch), expected)
    with pytest.raises(FileNotFoundError):
        SaccadePolicy.from_pretrained("owner/robot", revision="other", **here)
    with pytest.raises(FileNotFoundError, match="expected a directory or an id"):
        SaccadePolicy.from_pretrained("./no/such/folder")
    with pytest.raises(TypeError, match="no_such_option"):
        SaccadePolicy.from_pretrained(checkpoint, no_such_option=1)


def test_every_option_reaches_the_hub(checkpoint: Path) -> None:
    given: dict[str, Any] = {
        "force_download": True,
        "token": "secret",
        "cache_dir": "cache",
        "local_files_only": False,
        "revision": "main",
    }
    with mock.patch.object(
        files, "snapshot_download", autospec=True, return_value=str(checkpoint)
    ) as download:
        SaccadePolicy.from_pretrained("owner/robot", **given)
    assert download.call_args == mock.call("owner/robot", allow_patterns=list(files.FILES), **given)


@pytest.mark.parametrize(
    ("kind", "raised"),
    [
        (errors.RepositoryNotFoundError, FileNotFoundError),
        (errors.RevisionNotFoundError, FileNotFoundError),
        (errors.GatedRepoError, errors.GatedRepoError),
        (errors.HfHubHTTPError, errors.HfHubHTTPError),
    ],
)
def test_only_what_is_not_there_is_said_not_to_be_there(
    kind: type[errors.HfHubHTTPError], raised: type[Exception]
) -> None:
    error = kind("the Hub's words", response=mock.MagicMock(headers={}))
    with (
        mock.patch.object(files, "snapshot_download", side_effect=error),
        pytest.raises(raised, match="the Hub's words") as found,
    ):
        SaccadePolicy.from_pretrained("owner/robot")
    assert ("is not on the Hub" in str(found.value)) == (raised is FileNotFoundError)
