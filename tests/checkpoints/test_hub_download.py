"""Published checkpoints that are downloaded, from a server on this machine that plays the Hub."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

import saccade
from tests.helpers import layouts
from tests.helpers.hub_server import Hub, Repository, files_of, run

NAME = "nvidia/GR00T-N1.5-3B"
RESOLVE = f"""
from saccade._internal import hub, hub_files
def resolve(name={NAME!r}, revision=None, files=hub_files.POLICY):
    try:
        print("found", hub.resolve(name, revision, files=files))
    except OSError as error:
        print(type(error).__name__, error)
"""
#: Files of a published repository that saccade does not read.
UNREAD = {
    "README.png": b"image",
    "pytorch_model.bin": b"weights",
    "global_step10/optimizer.pt": b"state",
    "checkpoint-10/model.safetensors": b"other weights",
}
#: Those that a rewritten checkpoint keeps.
KEPT = {"README.md": b"[6]", "LICENSE": b"[7]", "chat_template.jinja": b"[8]", "train_config.json": b"[9]"}
# No two with the same content: huggingface_hub would download one of them only.
STATISTICS = {"processor/statistics.json": b"[1]", "embodiment_id.json": b"[2]"}
TOKENIZER = {"tokenizer.json": b"[3]", "merges.txt": b"[4]", "tokenizer/vocab.json": b"[5]"}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """A sharded checkpoint."""
    return files_of(layouts.write(tmp_path_factory.mktemp("published") / "source", "nvidia-sharded"))


@pytest.fixture
def hub(files: dict[str, bytes]) -> Iterator[Hub]:
    server = Hub()
    repository = server.repositories[NAME] = Repository()
    repository.commit(files | UNREAD | KEPT | STATISTICS | TOKENIZER)
    yield server
    server.close()


def found(result: subprocess.CompletedProcess[str]) -> Path:
    """The path that a program with `RESOLVE` found."""
    word, _, path = result.stdout.strip().partition(" ")
    assert word == "found", (result.stdout, result.stderr)
    return Path(path)


def test_only_what_is_read_is_downloaded(hub: Hub, files: dict[str, bytes], tmp_path: Path) -> None:
    online = run(f"{RESOLVE}\nresolve(files=hub_files.HEAD)", hub.endpoint, tmp_path)
    folder = found(online)
    assert hub.downloaded() == sorted(set(files) | set(STATISTICS))
    assert {name: (folder / name).read_bytes() for name in files} == files
    assert "Fetching" in online.stderr  # progress bars
    hub.requests.clear()
    assert found(run(f"{RESOLVE}\nresolve()", hub.endpoint, tmp_path)) == folder
    assert hub.downloaded() == sorted(TOKENIZER)
    hub.requests.clear()
    assert found(run(f"{RESOLVE}\nresolve()", hub.endpoint, tmp_path)) == folder
    assert [path for _, path in hub.requests] == [f"/api/models/{NAME}/revision/main"]
    hub.requests.clear()
    assert found(run(f"{RESOLVE}\nresolve(files=hub_files.WHOLE)", hub.endpoint, tmp_path)) == folder
    assert hub.downloaded() == sorted(KEPT)


def test_a_head_is_loaded_by_its_id_and_pickled_with_its_commit(
    hub: Hub, files: dict[str, bytes], tmp_path: Path
) -> None:
    folder = tmp_path / "local"
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    load = (
        "import pickle, saccade\n"
        f"head = saccade.ActionHead.from_pretrained({NAME!r}, embodiment_ids=[24])\n"
        "print(head.source)\n"
        "open('head.pickle', 'wb').write(pickle.dumps(head))"
    )
    first = hub.repositories[NAME].branches["main"]
    result = run(load, hub.endpoint, tmp_path)
    assert result.stdout.strip().endswith(first), result.stderr
    hub.repositories[NAME].commit({"config.json": b"damaged", "model.safetensors": b""})
    show = (
        "import pickle\nhead = pickle.load(open('head.pickle', 'rb'))\nprint(head.source)\nprint(head.config)"
    )
    again = run(show, hub.endpoint, tmp_path)
    source, config = again.stdout.strip().splitlines()
    assert source.endswith(first)
    assert config == str(saccade.ActionHead.from_pretrained(folder, embodiment_ids=[24]).config)


def test_a_policy_is_loaded_by_its_id_and_served_with_its_commit(hub: Hub, tmp_path: Path) -> None:
    pytest.importorskip("zmq")
    first = hub.repositories[NAME].commit(files_of(Path(saccade.demo_checkpoint())) | KEPT)
    load = (
        "import pickle, saccade\n"
        "from saccade.serve import Server, bind, open_log\n"
        f"policy = saccade.Policy.from_pretrained({NAME!r})\n"
        "open('parts.pickle', 'wb').write(pickle.dumps((policy.head, policy.backbone)))\n"
        "log = open_log('json')\n"
        "server = Server(policy, bind('127.0.0.1', 0), log)\n"
        "server.stop('test')\n"
        "server.run()\n"
        "log.close()"
    )
    result = run(load, hub.endpoint, tmp_path)
    assert json.loads(result.stdout.splitlines()[0])["commit"] == first, result.stderr
    assert not KEPT.keys() & set(hub.downloaded())
    hub.repositories[NAME].commit({"config.json": b"damaged", "model.safetensors": b""})
    pickled = (tmp_path / "parts.pickle").read_bytes()
    assert str(tmp_path).encode() not in pickled  # it is loaded on another machine too
    show = "import pickle\nfor part in pickle.load(open('parts.pickle', 'rb')): print(part.source)"
    sources = run(show, hub.endpoint, tmp_path).stdout.split()
    assert [Path(source).name for source in sources] == [first, first]


def test_a_report_names_id_and_commit(hub: Hub, tmp_path: Path) -> None:
    commit = hub.repositories[NAME].commit(files_of(Path(saccade.demo_checkpoint())))
    verify = "from saccade import cli\nraise SystemExit(cli.main(['verify', {!r}, *{!r}]))"
    text = run(verify.format(NAME, []), hub.endpoint, tmp_path)
    assert text.stdout.startswith(f"checkpoint  {NAME}@{commit}: GR00T"), text.stderr
    values = run(verify.format(NAME, ["--json"]), hub.endpoint, tmp_path)
    assert json.loads(values.stdout)["published"] == f"{NAME}@{commit}", values.stderr


def test_statistics_need_no_weights(hub: Hub, tmp_path: Path) -> None:
    load = f"import saccade\nprint(saccade.Normalizer.from_pretrained({NAME!r}, 'gr1'))"
    result = run(load, hub.endpoint, tmp_path)
    assert "data_config: expected one" in result.stderr  # the statistics were read
    assert "experiment_cfg/metadata.json" in hub.downloaded()
    assert not [name for name in hub.downloaded() if name.endswith(".safetensors")]


def test_revisions(hub: Hub, files: dict[str, bytes], tmp_path: Path) -> None:
    first = hub.repositories[NAME].branches["main"]
    second = hub.repositories[NAME].commit(files | {"statistics.json": b"{}"}, "pr/2")
    for words, commit in (
        ("", first),
        ("revision='pr/2'", second),
        (f"'{NAME}@pr/2'", second),
        (f"revision={second!r}", second),
    ):
        assert found(run(f"{RESOLVE}\nresolve({words})", hub.endpoint, tmp_path)).name == commit
    absent = run(f"{RESOLVE}\nresolve(revision='v9')", hub.endpoint, tmp_path)
    assert absent.stdout.startswith(
        f"FileNotFoundError id_or_path: {NAME}: the repository has no revision v9"
    )
    # A branch that moves is followed, and a commit needs no connection.
    third = hub.repositories[NAME].commit(files | {"statistics.json": b"[]"})
    assert found(run(f"{RESOLVE}\nresolve()", hub.endpoint, tmp_path)).name == third
    hub.requests.clear()
    assert found(run(f"{RESOLVE}\nresolve(revision={second!r})", hub.endpoint, tmp_path)).name == second
    assert hub.requests == []


@pytest.mark.parametrize("without", ["hub", "offline", "server"])
def test_without_a_connection_the_cache_is_used(hub: Hub, tmp_path: Path, without: str) -> None:
    program, environment = RESOLVE, {}
    if without == "hub":
        program = f"import sys; sys.modules['huggingface_hub'] = None\n{RESOLVE}"
    if without == "offline":
        environment = {"HF_HUB_OFFLINE": "1"}
    folder = found(run(f"{RESOLVE}\nresolve(files=hub_files.HEAD)", hub.endpoint, tmp_path))
    if without == "server":
        hub.close()
    again = run(f"{program}\nresolve(files=hub_files.HEAD)", hub.endpoint, tmp_path, **environment)
    assert found(again) == folder
    # That another commit may be the newest is told where the connection failed.
    assert ("may not be the newest" in again.stderr) == (without == "server")
    for words, message in (
        ("", r"only a part of it .* lacks merges\.txt, tokenizer\.json, tokenizer/vocab\.json"),
        ("revision='v9'", "not in the cache"),
        ("'nvidia/absent'", "not in the cache"),
    ):
        result = run(f"{program}\nresolve({words})", hub.endpoint, tmp_path, **environment)
        assert result.stdout.startswith("FileNotFoundError id_or_path: nvidia/")
        assert "hf download nvidia/" in result.stdout
        assert "pass the path of a directory" in result.stdout
        with pytest.raises(OSError, match=message):
            raise OSError(result.stdout)


@pytest.mark.parametrize("status", [500, 503, 429])
def test_a_hub_that_does_not_work_is_no_connection(hub: Hub, tmp_path: Path, status: int) -> None:
    folder = found(run(f"{RESOLVE}\nresolve()", hub.endpoint, tmp_path))
    hub.status = status
    again = run(f"{RESOLVE}\nresolve()", hub.endpoint, tmp_path)
    assert found(again) == folder
    assert f"{status}" in again.stderr


@pytest.mark.parametrize("status", [401, 403])
def test_denied_access_is_not_replaced_by_the_cache(hub: Hub, tmp_path: Path, status: int) -> None:
    found(run(f"{RESOLVE}\nresolve()", hub.endpoint, tmp_path))
    hub.status = status
    result = run(f"{RESOLVE}\nresolve()", hub.endpoint, tmp_path)
    assert result.stdout.startswith(("PermissionError", "FileNotFoundError"))
    assert "log in with: hf auth login" in result.stdout or "denies access" in result.stdout


def test_gated_files(hub: Hub, tmp_path: Path) -> None:
    hub.gated = True
    result = run(f"{RESOLVE}\nresolve()", hub.endpoint, tmp_path)
    assert result.stdout.startswith(f"PermissionError id_or_path: {NAME}: the Hub denies access: accept")


def test_what_is_not_published(hub: Hub, tmp_path: Path) -> None:
    (tmp_path / "nvidia").mkdir()
    result = run(f"{RESOLVE}\nresolve('nvidia/absent')", hub.endpoint, tmp_path)
    assert "(there is a folder nvidia, without absent in it), and no such repository" in result.stdout
    hub.repositories["nvidia/data"] = Repository()
    hub.repositories["nvidia/data"].commit({"config.json": b"{}", "model.bin": b""})
    result = run(f"{RESOLVE}\nresolve('nvidia/data')", hub.endpoint, tmp_path)
    assert "nvidia/data: the repository has no *.safetensors" in result.stdout
    assert hub.downloaded() == []
    hub.requests.clear()
    for path in ("./nvidia/absent", "/nvidia/absent", "nvidia/absent/x", "absent"):
        assert run(f"{RESOLVE}\nresolve({path!r})", hub.endpoint, tmp_path).stdout.startswith("found")
    assert hub.requests == []


def test_a_download_that_is_interrupted_is_continued(
    hub: Hub, files: dict[str, bytes], tmp_path: Path
) -> None:
    hub.cut = "model-00002-of-00003.safetensors"
    result = run(f"{RESOLVE}\nresolve()", hub.endpoint, tmp_path)
    assert result.stdout.startswith(f"FileNotFoundError id_or_path: {NAME}: the download stopped")
    offline = run(f"{RESOLVE}\nresolve()", hub.endpoint, tmp_path, HF_HUB_OFFLINE="1")
    assert offline.stdout.startswith("FileNotFoundError")
    hub.cut = ""
    folder = found(run(f"{RESOLVE}\nresolve()", hub.endpoint, tmp_path))
    assert {name: (folder / name).read_bytes() for name in files} == files


def test_the_tokenizer_of_another_repository(hub: Hub, tmp_path: Path) -> None:
    """A checkpoint without one: the released tokenizer is downloaded, and denied access is an error."""
    data = Path(__file__).parents[1] / "data" / "backbone"
    name = "lerobot/eagle2hg-processor-groot-n1p5"
    tokenizer = {
        "tokenizer.json": (data / "tiny_tokenizer.json").read_bytes(),
        "preprocessor_config.json": b"{}",
        "README.md": b"text",
    }
    program = (
        "import saccade\n"
        f"try: print(saccade.Processor.from_pretrained({str(data / 'n15_one_view.safetensors')!r}))\n"
        "except OSError as error: print(type(error).__name__, error)"
    )
    absent = run(program, hub.endpoint, tmp_path)
    assert "no published one can be used" in absent.stdout
    assert f"tokenizer: {name}: no such path, and no such repository" in absent.stdout
    hub.repositories[name] = Repository()
    hub.repositories[name].commit(tokenizer)
    assert "tokens=443" in run(program, hub.endpoint, tmp_path).stdout
    assert hub.downloaded() == ["preprocessor_config.json", "tokenizer.json"]
    assert "tokens=443" in run(program, hub.endpoint, tmp_path, HF_HUB_OFFLINE="1").stdout
    hub.status = 403
    assert run(program, hub.endpoint, tmp_path).stdout.startswith("PermissionError tokenizer: ")
