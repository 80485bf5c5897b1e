"""The plugin in lerobot: `make test-compat` runs this where lerobot is 0.5 or later.

The checkpoint is small and random, with the cameras, the state and the actions of saccade's simulated robot.
`lerobot-eval` runs as users start it, and its episodes are compared with those of `saccade.Policy.act`.
"""

# lerobot has no types.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

import doctest
import importlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from huggingface_hub import errors
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env
from lerobot.envs.utils import preprocess_observation
from lerobot.policies.factory import make_policy, make_policy_config, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins

import lerobot_policy_saccade
import saccade
from lerobot_policy_saccade import SaccadeConfig, SaccadeEnv, files
from lerobot_policy_saccade.modeling_saccade import SaccadePolicy
from saccade.checkpoints import random_checkpoint
from saccade.sim.cameras import DEFAULT_IMAGE_SIZE
from saccade.sim.environment import TaskEnvironment

VIEWS = ("left", "right", "top")
HORIZON, WIDTH = 16, 4
TEXTS = ["reach the red ball", "push", "open the drawer slowly"]


def random_policy(folder: Path, views: Sequence[str], size: int) -> Path:
    """A random checkpoint of the simulated robot: its hand in place of the arm, and these cameras."""
    random_checkpoint.write(
        folder,
        backbone=random_checkpoint.small_backbone("n1.5"),
        head=random_checkpoint.small_head("n1.5"),
    )
    path = folder / "experiment_cfg" / "metadata.json"
    metadata = json.loads(path.read_text())
    robot = metadata["new_embodiment"]
    view = {"resolution": [size, size], "channels": 3, "fps": 80.0}
    robot["modalities"]["video"] = dict.fromkeys(views, view)
    for kind in ("state", "action"):
        for part in (robot["statistics"], robot["modalities"]):
            part[kind] = {"hand": part[kind].pop("single_arm"), **part[kind]}
        hand = robot["statistics"][kind]["hand"]
        robot["statistics"][kind]["hand"] = {name: values[:3] for name, values in hand.items()}
        robot["modalities"][kind]["hand"]["shape"] = [3]
    path.write_text(json.dumps(metadata))
    (folder / "optimizer.pt").write_bytes(b"large")
    return folder


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_policy(tmp_path_factory.mktemp("whole") / "checkpoint", VIEWS, DEFAULT_IMAGE_SIZE)


@pytest.fixture(scope="module")
def policy(checkpoint: Path) -> SaccadePolicy:
    return SaccadePolicy(SaccadeConfig(checkpoint=str(checkpoint), num_threads=1, seed=7))


@pytest.fixture
def batch() -> dict[str, Any]:
    """Three observations as lerobot's processors give them."""
    shape = (len(VIEWS), 3, 3, DEFAULT_IMAGE_SIZE, DEFAULT_IMAGE_SIZE)
    frames = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    images = {
        f"observation.images.{name}": torch.from_numpy(seen).float() / 255
        for name, seen in zip(VIEWS, frames, strict=True)
    }
    state = torch.linspace(0, 0.5, 3 * WIDTH).reshape(3, WIDTH)
    return {**images, "observation.state": state, "task": TEXTS, "action": None, "next.reward": 0.0}


def plain(batch: dict[str, Any]) -> dict[str, Any]:
    """The same observations in Isaac-GR00T's form, with the pixels as bytes."""
    video = {
        name: (batch[f"observation.images.{name}"] * 255).byte().movedim(1, -1).numpy()[:, None]
        for name in VIEWS
    }
    state = batch["observation.state"].numpy()[:, None]
    return {
        "video": video,
        "state": {"hand": state[..., :3], "gripper": state[..., 3:]},
        "language": {"annotation.human.task_description": [[text] for text in batch["task"]]},
    }


def joined(answer: dict[str, Any]) -> np.ndarray[Any, Any]:
    return np.concatenate([answer["hand"], answer["gripper"]], -1)


def test_lerobot_finds_policy_and_environment_by_the_name_of_the_package() -> None:
    code = (
        "import sys; from lerobot.utils.import_utils import register_third_party_plugins as register;"
        "assert 'saccade' not in sys.modules; register();"
        "from lerobot.configs.policies import PreTrainedConfig; from lerobot.envs.configs import EnvConfig;"
        "print(PreTrainedConfig.get_choice_class('saccade').__name__,"
        "EnvConfig.get_choice_class('saccade').__name__, 'saccade.sim' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    # The simulation would decide how MuJoCo draws in other environments.
    assert done.stdout.split() == ["SaccadeConfig", "SaccadeEnv", "False"]


@pytest.mark.parametrize("name", ["configuration_saccade", "modeling_saccade", "processor_saccade", "files"])
def test_examples_in_docstrings(name: str) -> None:
    assert doctest.testmod(importlib.import_module(f"lerobot_policy_saccade.{name}")).failed == 0


def test_the_factories_make_it(checkpoint: Path, batch: dict[str, Any]) -> None:
    register_third_party_plugins()
    config = make_policy_config("saccade", checkpoint=str(checkpoint), num_threads=1)
    policy = make_policy(config, env_cfg=SaccadeEnv())
    assert isinstance(policy, SaccadePolicy)
    assert not list(policy.parameters())
    before, after = make_pre_post_processors(policy_cfg=config)
    action = after(policy.select_action(before(dict(batch))))
    assert action.shape == (3, WIDTH)
    assert action.dtype == torch.float32


def test_a_chunk_has_the_bits_of_saccade(policy: SaccadePolicy, batch: dict[str, Any]) -> None:
    policy.reset()
    for seed in (7, 8):
        chunk = policy.predict_action_chunk(batch)
        assert chunk.shape == (3, HORIZON, WIDTH)
        assert chunk.device.type == "cpu"
        np.testing.assert_array_equal(chunk.numpy(), joined(policy.policy.act(plain(batch), seed=seed)))
    policy.reset()
    again = policy.predict_action_chunk(batch)
    np.testing.assert_array_equal(again.numpy(), joined(policy.policy.act(plain(batch), seed=7)))


def test_noise_may_be_given(policy: SaccadePolicy, batch: dict[str, Any]) -> None:
    config = policy.policy.head.config
    noise = torch.randn(3, config.action_horizon, config.encoder_action_dim)
    chunk = policy.predict_action_chunk(batch, noise=noise)
    np.testing.assert_array_equal(chunk.numpy(), joined(policy.policy.act(plain(batch), noise=noise.numpy())))


def test_without_a_seed_torch_decides(checkpoint: Path, batch: dict[str, Any]) -> None:
    policy = SaccadePolicy(SaccadeConfig(checkpoint=str(checkpoint), num_threads=1))
    chunks = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        policy.reset()
        chunks.append(policy.predict_action_chunk(batch))
        assert not torch.equal(policy.predict_action_chunk(batch), chunks[-1])
    assert torch.equal(chunks[0], chunks[1])
    assert not torch.equal(chunks[0], chunks[2])


def test_actions_are_queued(checkpoint: Path, batch: dict[str, Any]) -> None:
    config = SaccadeConfig(checkpoint=str(checkpoint), num_threads=1, seed=0, n_action_steps=3, num_steps=2)
    policy = SaccadePolicy(config)
    chunks = [joined(policy.policy.act(plain(batch), seed=seed, num_steps=2)) for seed in (0, 1)]
    expected = [chunk[:, step] for chunk in chunks for step in range(3)]
    for action in expected:
        np.testing.assert_array_equal(policy.select_action(batch).numpy(), action)
    policy.select_action(batch)
    policy.reset()
    np.testing.assert_array_equal(policy.select_action(batch).numpy(), expected[0])


def test_keys_are_renamed(checkpoint: Path, policy: SaccadePolicy, batch: dict[str, Any]) -> None:
    renamed = {"observation.images.image2": "observation.images.right"}
    other = SaccadePolicy(
        SaccadeConfig(checkpoint=str(checkpoint), num_threads=1, seed=7, rename_map=renamed)
    )
    policy.reset()
    expected = policy.predict_action_chunk(batch)
    batch["observation.images.image2"] = batch.pop("observation.images.right")
    assert torch.equal(other.predict_action_chunk(batch), expected)
    with pytest.raises(saccade.InputError, match="embodiment 'new_embodiment' needs cameras left"):
        policy.predict_action_chunk(batch)


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


def action_of(width: int) -> dict[str, PolicyFeature]:
    return {"action": PolicyFeature(type=FeatureType.ACTION, shape=(width,))}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"checkpoint": None}, "checkpoint: expected a path or an id, got none"),
        ({"checkpoint": "no/such"}, "no/such: no such path, and not in the cache"),
        ({"device": "cuda"}, "device: expected 'cpu', got 'cuda'"),
        ({"n_action_steps": 0}, "n_action_steps: expected at least 1, got 0"),
        ({"n_action_steps": 17}, "n_action_steps: expected at most 16"),
        ({"precision": "fp4"}, "precision: .*fp4"),
        ({"preprocessing": "other"}, "preprocessing: .*other"),
        ({"embodiment": "other"}, "other"),
        ({"embodiment": "3"}, "3"),
        ({"cameras": ["front"]}, "cameras: .*front"),
        (
            {"output_features": action_of(7)},
            r"action: expected an environment of 4 numbers, hand \(3\), gripper \(1\), got 7",
        ),
    ],
)
def test_wrong_options_are_errors(checkpoint: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        SaccadePolicy(SaccadeConfig(**{"checkpoint": str(checkpoint), "num_threads": 1, **options}))


def test_training_is_an_error(policy: SaccadePolicy, batch: dict[str, Any]) -> None:
    methods = (
        policy.get_optim_params,
        policy.config.get_optimizer_preset,
        policy.config.get_scheduler_preset,
    )
    for method in (*methods, lambda: policy.forward(batch), lambda: policy(batch)):
        with pytest.raises(NotImplementedError, match="saccade policies are for inference only"):
            method()


def test_the_environment_is_that_of_the_task() -> None:
    config = EnvConfig.get_choice_class("saccade")(task="push", image_size=16)
    assert config.gym_kwargs == {"render_mode": "rgb_array", "image_size": 16}
    assert config.features["pixels/top"].shape == (16, 16, 3)
    assert lerobot_policy_saccade.SaccadeEnv(task="reach").gym_id == "saccade/reach-lerobot-v0"
    with pytest.raises(saccade.InputError, match="no-such-task"):
        SaccadeEnv(task="no-such-task")


def test_an_environment_of_lerobot(tmp_path: Path) -> None:
    config = EnvConfig.get_choice_class("metaworld")(task="reach-v3")
    vector = make_env(config, n_envs=1)["reach-v3"][0]
    try:
        observation, _ = vector.reset(seed=[0])
        size = observation["pixels"].shape[1]
        # An environment with one camera does not name it.
        folder = random_policy(tmp_path / "checkpoint", ["image"], size)
        policy = make_policy(make_policy_config("saccade", checkpoint=str(folder)), env_cfg=config)
        batch = preprocess_observation(observation) | {"task": list(vector.call("task_description"))}
        vector.step(policy.select_action(batch).numpy())
    finally:
        vector.close()


def evaluate(out: Path, *arguments: str) -> dict[str, Any]:
    """What `lerobot-eval` writes."""
    command = [sys.executable, "-m", "lerobot.scripts.lerobot_eval", f"--output_dir={out}", *arguments]
    done = subprocess.run(
        command, cwd=out.parent, env=os.environ | {"HF_HUB_OFFLINE": "1"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-4000:]
    return json.loads((out / "eval_info.json").read_text())


def episode(policy: saccade.Policy, task: str, seed: int, first: int) -> float:
    """The sum of rewards of an episode in this process. The chunks have the seeds from `first` on."""
    environment = TaskEnvironment(task)
    observation, _ = environment.reset(seed=seed)
    total, steps, done = 0.0, 0, False
    chunk = np.zeros((HORIZON, WIDTH))
    while not done:
        if steps % HORIZON == 0:
            state = observation["proprio"][None]
            seen = {
                "video": {name: image[None] for name, image in observation["images"].items()},
                "state": {"hand": state[:, :3], "gripper": state[:, 3:]},
                "language": {"annotation.human.task_description": observation["instruction"]},
            }
            chunk = joined(policy.act(seen, seed=first + steps // HORIZON))
        observation, reward, terminated, truncated, _ = environment.step(chunk[steps % HORIZON])
        total, steps, done = total + reward, steps + 1, terminated or truncated
    environment.close()
    return total


def test_lerobot_eval_runs_a_checkpoint(checkpoint: Path, policy: SaccadePolicy, tmp_path: Path) -> None:
    info = evaluate(
        tmp_path / "out",
        "--policy.type=saccade",
        f"--policy.checkpoint={checkpoint}",
        "--policy.num_threads=1",
        "--policy.seed=7",
        "--env.type=saccade",
        "--env.task=reach",
        "--eval.batch_size=1",
        "--eval.n_episodes=1",
        "--seed=12",
    )
    (total,) = info["per_task"][0]["metrics"]["sum_rewards"]
    assert total == pytest.approx(episode(policy.policy, "reach", seed=12, first=7), rel=1e-12)
    assert list((tmp_path / "out").rglob("*.mp4"))


def test_lerobot_eval_runs_a_saved_policy_in_several_environments(
    policy: SaccadePolicy, tmp_path: Path
) -> None:
    policy.save_pretrained(tmp_path / "saved")
    info = evaluate(
        tmp_path / "out",
        f"--policy.path={tmp_path / 'saved'}",
        "--policy.n_action_steps=16",
        "--env.type=saccade",
        "--env.task=push",
        "--eval.batch_size=2",  # in processes of their own since lerobot 0.6
        "--eval.n_episodes=2",
        "--seed=3",
    )
    metrics = info["per_task"][0]["metrics"]
    assert len(metrics["sum_rewards"]) == len(metrics["successes"]) == 2
    # The noise of the first row is that of a batch of one.
    assert metrics["sum_rewards"][0] == pytest.approx(
        episode(policy.policy, "push", seed=3, first=7), rel=1e-12
    )
