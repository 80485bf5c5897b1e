"""The whole head at N1.5's size beside the same work in torch, in one interleaved run.

    python benches/compare_torch.py                         1 and 2 threads, one view (T_vl 296), 4 Euler
    steps python benches/compare_torch.py --threads 2 --rounds 3 --contenders saccade-f32 lerobot-f32
    python benches/compare_torch.py --size small --rounds 2  seconds instead of minutes, to see that it works
    python benches/compare_torch.py --json > result.json

Each contender lives in a process of its own and waits on a pipe while another one works: no idle OpenMP
thread spins beside the one that is measured, and nobody shares an allocator. A round lets every contender do
every piece of work once, in an order that rotates, so that a drift of the machine's clock meets all of them.
Reported are medians over the rounds with the first and third quartile. All contenders have the same random
weights, every one of them a bfloat16 number, so that storing them in bfloat16 loses nothing; their actions
are compared as well.

torch gets the fastest settings that leave its result correct: inference mode, huge pages for its weights,
bfloat16 both as lerobot runs it (autocast over float32 weights) and with the weights converted beforehand.

Memory for all contenders at full size: about 16 GB. Needs the packages of the test set-up, lerobot among
them.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.metadata
import json
import multiprocessing
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from saccade import HeadConfig

WORKS = ("encode", "sample", "both")
CONTENDERS = {
    "saccade-f32": "saccade, float32 weights",
    "saccade-bf16-stored": "saccade, weights stored in bfloat16, float32 arithmetic",
    "reference-f32": "saccade.reference, float32",
    "lerobot-f32": "lerobot 0.4.4, float32",
    "lerobot-bf16-autocast": "lerobot 0.4.4, bfloat16 autocast over float32 weights",
    "lerobot-bf16": "lerobot 0.4.4, bfloat16 autocast over bfloat16 weights",
}
NUM_EMBODIMENTS = 2  # the work does not depend on how many there are, memory does


@dataclass(frozen=True)
class Inputs:
    """One observation and one draw of noise."""

    backbone_features: NDArray[np.float32]
    state: NDArray[np.float32]
    embodiment_id: NDArray[np.int64]
    noise: NDArray[np.float32]


Works = dict[str, Callable[[], Any]]


def saccade_works(folder: Path, inputs: Inputs, threads: int) -> Works:
    """The Rust head; `sample` starts from a context, as it does in a control loop."""
    import saccade

    head = saccade.ActionHead.load(folder, num_threads=threads)
    head.warmup(inputs.backbone_features.shape[1])
    context = head.encode(inputs.backbone_features)

    def sample(observed: saccade.Context) -> Any:
        return head.sample(observed, inputs.state, inputs.embodiment_id, noise=inputs.noise)

    return {
        "encode": lambda: head.encode(inputs.backbone_features),
        "sample": lambda: sample(context),
        "both": lambda: sample(head.encode(inputs.backbone_features)),
    }


def reference_works(folder: Path, inputs: Inputs, threads: int) -> Works:
    """`saccade.reference` in float32."""
    import torch

    from saccade.reference import ActionHead

    torch.set_num_threads(threads)
    head = ActionHead.load(folder)
    with torch.inference_mode():
        in_own_memory(head)
    features, state, ids, noise = (torch.from_numpy(array) for array in vars(inputs).values())
    vl_embs = torch.inference_mode()(head.encode)(features)

    def run(work: Callable[[], Any]) -> Callable[[], Any]:
        return torch.inference_mode()(work)

    return {
        "encode": run(lambda: head.encode(features)),
        "sample": run(lambda: head.sample(vl_embs, state, ids, noise=noise)),
        "both": run(lambda: head(features, state, ids, noise=noise)),
    }


def lerobot_works(folder: Path, inputs: Inputs, threads: int, *, autocast: bool, bf16_weights: bool) -> Works:
    """lerobot's own head; for `sample` its work on the features is replaced by its earlier result."""
    import torch

    from saccade.reference import ActionHead, lerobot_head

    torch.set_num_threads(threads)
    head: Any = lerobot_head.build(json.loads((folder / "config.json").read_text()), device="meta")
    head.load_state_dict(ActionHead.load(folder).state_dict(), assign=True)
    in_own_memory(head, torch.bfloat16 if bf16_weights else torch.float32)
    features, state, ids, noise = (torch.from_numpy(array) for array in vars(inputs).values())
    if autocast:  # as lerobot does: float inputs are cast before the head is called
        features, state = features.bfloat16(), state.bfloat16()
    encode = head.process_backbone_output

    def run(work: Callable[[], Any]) -> Callable[[], Any]:
        def timed() -> Any:
            with torch.inference_mode(), torch.autocast("cpu", dtype=torch.bfloat16, enabled=autocast):
                return work()

        return timed

    vl_embs = run(lambda: encode({"backbone_features": features})["backbone_features"])()

    def sample() -> Any:
        head.process_backbone_output = lambda output: output
        try:
            return lerobot_head.get_action(head, vl_embs, state, ids, noise)
        finally:
            head.process_backbone_output = encode

    return {
        "encode": run(lambda: encode({"backbone_features": features})),
        "sample": run(sample),
        "both": run(lambda: lerobot_head.get_action(head, features, state, ids, noise)),
    }


def in_own_memory(module: Any, dtype: Any = None) -> None:
    """Copies weights out of the mapped file, so that torch's allocator can use huge pages; frozen."""
    module.requires_grad_(False)
    for parameter in module.parameters():
        parameter.data = parameter.data.to(dtype=dtype, copy=True)


def build_works(name: str, folders: dict[str, Path], inputs: Inputs, threads: int) -> Works:
    """What the contender of that name can be asked to do."""
    if name.startswith("saccade"):
        return saccade_works(folders["bfloat16" if "bf16" in name else "float32"], inputs, threads)
    if name.startswith("reference"):
        return reference_works(folders["float32"], inputs, threads)
    bf16 = "bf16" in name
    return lerobot_works(
        folders["float32"],
        inputs,
        threads,
        autocast=bf16,
        bf16_weights=bf16 and not name.endswith("autocast"),
    )


def contender(pipe: Connection, name: str, folders: dict[str, Path], inputs: Inputs, threads: int) -> None:
    """A contender's process: builds its head, then does what each message says and answers with seconds."""
    try:
        works = build_works(name, folders, inputs, threads)
        actions = works["both"]()  # the first call allocates and compiles; it is not timed
        pipe.send(np.asarray(actions.float() if hasattr(actions, "float") else actions))
        while (work := pipe.recv()) is not None:
            start = time.perf_counter()
            works[work]()
            pipe.send(time.perf_counter() - start)
    except Exception as error:
        pipe.send(error)


def answer(pipe: Connection) -> Any:
    """The contender's next message; its exception is raised here."""
    message = pipe.recv()
    if isinstance(message, Exception):
        raise message
    return message


@contextlib.contextmanager
def contenders(
    names: list[str], folders: dict[str, Path], inputs: Inputs, threads: int
) -> Iterator[tuple[dict[str, Connection], dict[str, NDArray[np.float32]]]]:
    """Processes that have built their heads, one after the other, and the actions that each returned."""
    context = multiprocessing.get_context("spawn")
    environment = {
        "OMP_NUM_THREADS": str(threads),
        "MKL_NUM_THREADS": str(threads),
        "THP_MEM_ALLOC_ENABLE": "1",  # torch then asks for huge pages
    }
    pipes, actions, processes = {}, {}, []
    before = os.environ.copy()
    os.environ.update(environment)  # read by a child when it imports torch
    try:
        for name in names:
            note(f"{threads} threads: building {name}")
            pipes[name], theirs = context.Pipe()
            process = context.Process(
                target=contender, args=(theirs, name, folders, inputs, threads), daemon=True
            )
            process.start()
            processes.append(process)
            actions[name] = answer(pipes[name])
        yield pipes, actions
    finally:
        os.environ.clear()
        os.environ.update(before)
        for pipe in pipes.values():
            with contextlib.suppress(OSError):
                pipe.send(None)
        for process in processes:
            process.join(timeout=30)
            process.kill()


def measure(pipes: dict[str, Connection], rounds: int, pause: float) -> dict[str, dict[str, list[float]]]:
    """Seconds of every contender and piece of work, `rounds` each, interleaved."""
    names = list(pipes)
    seconds: dict[str, dict[str, list[float]]] = {name: {work: [] for work in WORKS} for name in names}
    for index in range(rounds):
        note(f"round {index + 1} of {rounds}")
        for name in names[index % len(names) :] + names[: index % len(names)]:
            for work in WORKS:
                time.sleep(pause)  # the threads of the one before have gone to sleep by then
                pipes[name].send(work)
                seconds[name][work].append(answer(pipes[name]))
    return seconds


def exact_macs(config: HeadConfig, num_vl_tokens: int) -> dict[str, float]:
    """Multiply-accumulates of the exact computation for one observation, nothing done twice.

    Keys and values of the cross blocks once, the last self-attention block and the output for the action rows
    only, all that depends on the time alone kept from an earlier chunk.
    """
    vl, width, hidden, horizon = num_vl_tokens, config.width, config.hidden_dim, config.action_horizon
    rows = 1 + config.num_future_tokens + horizon
    cross = [index % 2 == 0 or not config.interleave_self_attention for index in range(config.num_layers)]
    encode = config.vl_num_layers * (12 * vl * config.context_dim**2 + 2 * vl * vl * config.context_dim)
    encode += sum(cross) * 2 * vl * config.context_dim * width
    step = 0
    for index, is_cross in enumerate(cross):
        last_is_self = index == config.num_layers - 1 and not is_cross
        queries = horizon if last_is_self else rows
        keys = vl if is_cross else rows
        step += (
            queries * 10 * width**2 + 2 * queries * keys * width
        )  # query, output, feed-forward; scores, values
        step += 0 if is_cross else rows * 2 * width**2  # keys and values of the rows
    step += horizon * (config.encoder_action_dim * width + 2 * width**2)  # action encoder
    step += horizon * (width * hidden + hidden**2 + hidden * config.action_dim)  # output and decoder
    state = config.state_history * config.state_dim * hidden + hidden * width
    sample = config.num_steps * step + state
    return {"encode": encode, "sample": sample, "both": encode + sample}


def measured_peak(isa: str, threads: int) -> float:
    """GMAC/s of float32 multiply-adds from registers, as `cargo bench --bench peak` measures them now."""
    with tempfile.NamedTemporaryFile(suffix=".json") as file:
        command = ["cargo", "bench", "--quiet", "--package", "saccade-benches", "--bench", "peak", "--"]
        command += ["--threads", str(threads), "--rounds", "10", "--json", file.name]
        subprocess.run(command, check=True, cwd=Path(__file__).parent, stdout=subprocess.DEVNULL)
        report = json.load(file)
    rates = (rate for case in report["cases"] for rate in case["rates"])
    return float(next(rate["gmacs"]["median"] for rate in rates if rate["name"].endswith(isa)))


def quartiles(values: list[float]) -> tuple[float, float, float]:
    """First quartile, median, third quartile."""
    if len(values) == 1:
        return values[0], values[0], values[0]
    first, median, third = statistics.quantiles(values, n=4, method="inclusive")
    return first, median, third


def summarise(
    seconds: dict[str, dict[str, list[float]]],
    actions: dict[str, NDArray[np.float32]],
    macs: dict[str, float],
    peak: float | None,
) -> list[dict[str, Any]]:
    """One record a contender: quartiles, ratio to the first contender, share of the exact floor."""
    first = next(iter(seconds))
    records = []
    for name, works in seconds.items():
        record: dict[str, Any] = {"contender": name, "max_abs_from_first": None}
        record["max_abs_from_first"] = float(np.abs(actions[name] - actions[first]).max())
        for work, values in works.items():
            low, median, high = quartiles(values)
            paired = [own / base for own, base in zip(values, seconds[first][work], strict=True)]
            record[work] = {
                "seconds": values,
                "quartiles": [low, median, high],
                "times_first": list(quartiles(paired)),
                "floor_share": None if peak is None else macs[work] / (peak * 1e9) / median,
            }
        records.append(record)
    return records


def markdown(report: dict[str, Any]) -> str:
    """The report as tables."""
    macs = report["macs"]
    lines = [
        f"{report['machine']}, {report['size']}, T_vl {report['num_vl_tokens']}, "
        f"{report['num_steps']} steps, {report['rounds']} rounds. "
        f"Exact floor: encode {macs['encode'] / 1e9:.1f}, sample {macs['sample'] / 1e9:.1f} GMAC.",
        f"torch {report['torch']}, saccade {report['saccade']} ({report['isa']}).",
    ]
    for run in report["runs"]:
        peak = "not measured" if run["peak_gmacs"] is None else f"{run['peak_gmacs']:.0f} GMAC/s"
        lines += ["", f"{run['threads']} threads, float32 FMA peak {peak}; median ms (quartiles)", ""]
        lines += ["| contender | encode | sample | both | both / first | floor share | max abs from first |"]
        lines += ["|---|---|---|---|---|---|---|"]
        for record in run["contenders"]:
            cells = [CONTENDERS[record["contender"]]]
            for work in WORKS:
                low, median, high = (1e3 * value for value in record[work]["quartiles"])
                cells.append(f"{median:.1f} ({low:.1f}–{high:.1f})")
            low, median, high = record["both"]["times_first"]
            cells.append(f"{median:.2f} ({low:.2f}–{high:.2f})")
            share = record["both"]["floor_share"]
            cells.append("" if share is None else f"{100 * share:.0f} %")
            cells.append(f"{record['max_abs_from_first']:.1e}")
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def write_weights(folders: dict[str, Path], size: str) -> None:
    """The same random weights in both files; in a child process, so that this one stays small."""
    import torch

    from saccade.reference import random_weights

    config = (
        random_weights.small_config()
        if size == "small"
        else random_weights.n15_config(num_embodiments=NUM_EMBODIMENTS)
    )
    for name, folder in folders.items():
        folder.mkdir()
        random_weights.write_checkpoint(folder, config, 0, dtype=getattr(torch, name), through=torch.bfloat16)


def random_inputs(config: HeadConfig, num_vl_tokens: int) -> Inputs:
    """Standard normal inputs, batch 1."""
    generator = np.random.default_rng(0)

    def normal(*shape: int) -> NDArray[np.float32]:
        return generator.standard_normal(shape, dtype=np.float32)

    return Inputs(
        backbone_features=normal(1, num_vl_tokens, config.context_dim),
        state=normal(1, config.state_history, config.state_dim),
        embodiment_id=np.array([1]),
        noise=normal(1, config.action_horizon, config.encoder_action_dim),
    )


def cpu_model() -> str:
    """The processor's name as Linux gives it."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")),
        platform.machine(),
    )


def note(message: str) -> None:
    """Progress, beside the result."""
    print(f"compare: {message} ...", file=sys.stderr, flush=True)


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="thread counts (default 1 2)")
    parser.add_argument("--rounds", type=int, default=9, help="repetitions of everything (default 9)")
    parser.add_argument(
        "--contenders",
        nargs="+",
        choices=CONTENDERS,
        default=list(CONTENDERS),
        metavar="NAME",
        help="the others are compared with the first; of: " + ", ".join(CONTENDERS),
    )
    parser.add_argument(
        "--size", choices=("full", "small"), default="full", help="small: to see that it works"
    )
    parser.add_argument("--vl-tokens", type=int, default=296, help="T_vl (default 296, one view)")
    parser.add_argument("--peak", action="store_true", help="measure the FMA peak too (needs cargo)")
    parser.add_argument(
        "--pause", type=float, default=0.2, help="seconds of rest before each measurement (default 0.2)"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of Markdown")
    return parser.parse_args()


def main() -> None:
    """Measures and prints."""
    args = parse()
    import saccade

    report: dict[str, Any] = {
        "machine": cpu_model(),
        "size": f"N1.5 {args.size} size, random weights",
        "runs": [],
    }
    report |= {"num_vl_tokens": args.vl_tokens, "rounds": args.rounds, "contenders": CONTENDERS}
    report |= {"saccade": saccade.__version__, "isa": saccade.show_config("dicts")["isa"]}
    with tempfile.TemporaryDirectory(prefix="saccade-compare-") as temporary:
        folders = {name: Path(temporary) / name for name in ("float32", "bfloat16")}
        note("writing random weights")
        writer = multiprocessing.get_context("spawn").Process(target=write_weights, args=(folders, args.size))
        writer.start()
        writer.join()
        if writer.exitcode != 0:
            raise SystemExit("compare: the weights could not be written")
        config = saccade.HeadConfig.from_file(folders["float32"] / "config.json")
        report |= {"num_steps": config.num_steps, "macs": exact_macs(config, args.vl_tokens)}
        inputs = random_inputs(config, args.vl_tokens)
        for threads in args.threads:
            with contenders(args.contenders, folders, inputs, threads) as (pipes, actions):
                peak = measured_peak(report["isa"], threads) if args.peak else None
                seconds = measure(pipes, args.rounds, args.pause)
            records = summarise(seconds, actions, report["macs"], peak)
            report["runs"].append({"threads": threads, "peak_gmacs": peak, "contenders": records})
    report["torch"] = importlib.metadata.version("torch")
    print(json.dumps(report, indent=1) if args.json else markdown(report))


if __name__ == "__main__":
    main()
