"""Latency in practice: chunks on a busy machine, many callers, small heads, the minimum cost of a call.

    python -m benches.latency                       all sections; half an hour, most of it the first one
    python -m benches.latency loaded --chunks 40    one section: loaded, callers, small or overhead
    python -m benches.latency report                prints the results in out/latency/results.json

- `loaded`: chunks (encode and sample) at N1.5's size while other processes, one per core, are busy; compared
  with lerobot's head. The fair share of the machine is then half of it, which means twice the idle time.
- `callers`: 8 Python threads that sample at the same time, compared with one thread that does all the work.
- `small`: a head of the bundled policy's sizes, compared with torch.
- `overhead`: a head so small that its arithmetic takes no time; what remains is dispatch and binding.

Each contender runs in a process of its own, as in `benches.peers`, and they take turns. Run it on an idle
machine. Results are kept as JSON. A section that runs again replaces its results, except that `loaded` adds
its chunks, so it can be measured in several sessions.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import signal
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import saccade
from benches.files import write_text
from benches.latency_contenders import Contenders, checkpoint, note, timed
from benches.peers import inputs, machine
from benches.peers.cases import Case
from benches.peers.contenders import CONTENDERS

SECTIONS = ("loaded", "callers", "small", "overhead")
LOADED = ("saccade-float32", "saccade-bfloat16", "saccade-int8", "lerobot-bfloat16")
SMALL = (
    "saccade-float32",
    "saccade-bfloat16",
    "lerobot-float32",
    "lerobot-bfloat16",
    "torch-float32",
    "compile-float32",
)
NUM_CALLERS = 8
SETTLE = 0.3  # seconds for the scheduler to distribute a new load

Report = dict[str, Any]


@contextlib.contextmanager
def busy_processes(count: int) -> Iterator[Callable[[bool], None]]:
    """Processes that are busy after `work(True)` and stopped after `work(False)`."""
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]

    def work(on: bool) -> None:
        for process in processes:
            process.send_signal(signal.SIGCONT if on else signal.SIGSTOP)
        time.sleep(SETTLE)

    try:
        time.sleep(SETTLE)
        work(False)
        yield work
    finally:
        for process in processes:
            process.kill()
            process.wait()


def rotated(names: list[str], turn: int) -> list[str]:
    """Every name once, with a different first name each turn."""
    turn %= len(names)
    return names[turn:] + names[:turn]


def loaded(args: argparse.Namespace, before: Report) -> Report:
    """Times of chunks while other processes keep every core busy, and on the idle machine."""
    case = Case("head", args.threads, size=args.size)
    source = checkpoint(inputs.config_of(case), args.work / f"n15-{args.size}")
    names = list(args.contenders or LOADED)
    busy = args.busy or machine.describe()["cores"]
    report: Report = {"case": case.as_dict(), "busy": busy, "seconds": {}}
    if before and (before["case"], before["busy"]) == (report["case"], busy):
        report = before
    seconds: dict[str, dict[str, list[float]]] = report["seconds"]
    for name in names:
        seconds.setdefault(name, {"quiet": [], "loaded": []})
    rounds = -(-args.chunks // args.chunks_a_turn)
    with Contenders(names, case, source, args.work) as contenders, busy_processes(busy) as work:
        for turn in range(rounds):
            for name in rotated(names, turn):
                note(f"loaded: round {turn + 1} of {rounds}, {name}")
                quiet = max(2, args.chunks_a_turn // 3)
                seconds[name]["quiet"] += contenders.ask(name, "both", quiet)
                work(True)
                seconds[name]["loaded"] += contenders.ask(name, "both", args.chunks_a_turn)
                work(False)
    return report


def loaded_table(report: Report) -> list[str]:
    """How much longer a chunk takes under load."""
    lines = [
        f"N1.5, encode and sample, {report['case']['threads']} threads; "
        f"with {report['busy']} busy processes running at the same time.",
        "",
        "| contender | idle p50, ms | loaded p50, ms | loaded / idle | p90 / p50 | p99 / p50 | chunks |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, seconds in report["seconds"].items():
        quiet, load = statistics.median(seconds["quiet"]), np.quantile(seconds["loaded"], (0.5, 0.9, 0.99))
        lines.append(
            f"| {CONTENDERS[name].label} | {1e3 * quiet:.0f} | {1e3 * load[0]:.0f} | {load[0] / quiet:.2f} "
            f"| {load[1] / load[0]:.2f} | {load[2] / load[0]:.2f} | {len(seconds['loaded'])} |"
        )
    return lines


def callers(args: argparse.Namespace, before: Report) -> Report:
    """Chunks per second of one caller and of several, alternating; and whether all have the same bits."""
    del before
    whole = Case("head", args.threads, size=args.size)
    heads = {
        "the bundled policy's size": (policy_config(), "policy", 56, 40 if args.size == "full" else 5),
        f"N1.5's structure ({args.size})": (inputs.config_of(whole), f"n15-{args.size}", 296, 1),
    }
    cases = {}
    for label, (config, name, num_vl_tokens, each) in heads.items():
        case = Case("head", args.threads, num_vl_tokens=num_vl_tokens)
        source = checkpoint(config, args.work / name)
        head = saccade.ActionHead.from_pretrained(source, num_threads=args.threads)
        arrays = inputs.inputs_of(case, head.config)
        context, noise = head.encode(arrays["features"]), arrays["noise"][:, 0]
        expected = head.sample(context, arrays["state"], inputs.EMBODIMENT, noise=noise)
        wrong: list[bool] = []

        def sample(
            times: int,
            head: Any = head,
            context: Any = context,
            state: Any = arrays["state"],
            noise: Any = noise,
            expected: Any = expected,
            wrong: list[bool] = wrong,
        ) -> None:
            out = np.empty_like(expected)
            for _ in range(times):
                head.sample(context, state, inputs.EMBODIMENT, noise=noise, out=out)
                if out.tobytes() != expected.tobytes():
                    wrong.append(True)

        rates: dict[str, list[float]] = {"one": [], "several": []}
        for turn in range(args.rounds + 1):
            note(f"callers: {label}, round {turn} of {args.rounds}")
            one = timed(lambda sample=sample, each=each: sample(NUM_CALLERS * each))  # type: ignore[misc]
            threads = [threading.Thread(target=sample, args=(each,)) for _ in range(NUM_CALLERS)]
            start = time.perf_counter()
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            several = time.perf_counter() - start
            if turn > 0:  # the first round allocates the workspaces
                rates["one"].append(NUM_CALLERS * each / one)
                rates["several"].append(NUM_CALLERS * each / several)
        cases[label] = {"rates": rates, "wrong": len(wrong)}
    return {"threads": args.threads, "cases": cases}


def callers_table(report: Report) -> list[str]:
    """Throughput of several callers over that of one."""
    lines = [
        f"`sample` on one context, with a head of {report['threads']} threads.",
        "",
        f"| head | chunks per second, 1 caller | {NUM_CALLERS} callers | ratio (min, max) | different bits |",
        "|---|---|---|---|---|",
    ]
    for label, case in report["cases"].items():
        one, several = case["rates"]["one"], case["rates"]["several"]
        ratios = sorted(b / a for a, b in zip(one, several, strict=True))
        lines.append(
            f"| {label} | {statistics.median(one):.4g} | {statistics.median(several):.4g} "
            f"| {statistics.median(ratios):.2f} ({ratios[0]:.2f}, {ratios[-1]:.2f}) | {case['wrong']} |"
        )
    return lines


def small(args: argparse.Namespace, before: Report) -> Report:
    """Times of a head of the bundled policy's sizes, and of torch."""
    del before
    runs = []
    source = checkpoint(policy_config(), args.work / "policy")
    names = list(args.contenders or SMALL)
    for threads in sorted({1, args.threads}):
        case = Case("head", threads, num_vl_tokens=98)
        seconds: dict[str, dict[str, list[float]]] = {name: {"sample": [], "both": []} for name in names}
        with Contenders(names, case, source, args.work) as contenders:
            for turn in range(args.rounds):
                for name in rotated(names, turn):
                    for work in ("sample", "both"):
                        taken = contenders.ask(name, work, 20)
                        seconds[name][work].append(statistics.median(taken))
        runs.append({"threads": threads, "seconds": seconds})
    return {"runs": runs}


def small_table(report: Report) -> list[str]:
    """Times of a chunk, and their ratio to the first contender's."""
    lines = ["The bundled policy's sizes: width 128, 4 blocks, T_vl 98, 4 Euler steps.", ""]
    lines += ["| contender | threads | sample, ms | encode and sample, ms | sample / saccade's |"]
    lines += ["|---|---|---|---|---|"]
    for run in report["runs"]:
        first = next(iter(run["seconds"].values()))
        for name, seconds in run["seconds"].items():
            ratio = statistics.median(a / b for a, b in zip(seconds["sample"], first["sample"], strict=True))
            middle = {work: 1e3 * statistics.median(taken) for work, taken in seconds.items()}
            lines.append(
                f"| {CONTENDERS[name].label} | {run['threads']} "
                f"| {middle['sample']:.2f} | {middle['both']:.2f} | {ratio:.1f} |"
            )
    return lines


def overhead(args: argparse.Namespace, before: Report) -> Report:
    """Calls of a head of one block, width 8, without VL self-attention: some hundred multiply-adds."""
    del before
    config = policy_config()
    config |= {"backbone_embedding_dim": 8, "hidden_size": 8, "input_embedding_dim": 8}
    config |= {"num_target_vision_tokens": 1, "action_horizon": 1, "max_seq_len": 1, "use_vlln": False}
    config["diffusion_model_cfg"] |= {
        "num_layers": 1,
        "num_attention_heads": 1,
        "attention_head_dim": 8,
        "cross_attention_dim": 8,
        "output_dim": 8,
    }
    config["vl_self_attention_cfg"] |= {"num_layers": 0}
    head = saccade.ActionHead.from_pretrained(
        checkpoint(config, args.work / "tiny"), num_threads=args.threads
    )
    case = Case("head", args.threads, num_vl_tokens=1)
    arrays = inputs.inputs_of(case, head.config)
    context, noise, state = head.encode(arrays["features"]), arrays["noise"][:, 0], arrays["state"]
    out = head.sample(context, state, inputs.EMBODIMENT, noise=noise)
    works: dict[str, Callable[[], Any]] = {
        "sample, 1 step, noise and out given": lambda: head.sample(
            context, state, inputs.EMBODIMENT, noise=noise, out=out, num_steps=1
        ),
        "sample, 4 steps, noise and out given": lambda: head.sample(
            context, state, inputs.EMBODIMENT, noise=noise, out=out
        ),
        "sample, 1 step, an integer as seed": lambda: head.sample(
            context, state, inputs.EMBODIMENT, seed=1, num_steps=1
        ),
        "encode": lambda: head.encode(arrays["features"]),
    }
    seconds = {}
    for name, work in works.items():

        def often(work: Callable[[], Any] = work) -> None:
            for _ in range(100):
                work()

        often()
        seconds[name] = [timed(often) / 100 for _ in range(20 * args.rounds)]
    return {"seconds": seconds}


def overhead_table(report: Report) -> list[str]:
    """Microseconds per call."""
    lines = ["A head of one block, width 8, one token each of observation, future and action.", ""]
    lines += ["| call | median, us | p90, us |", "|---|---|---|"]
    for name, seconds in report["seconds"].items():
        median, high = 1e6 * np.quantile(seconds, (0.5, 0.9))
        lines.append(f"| {name} | {median:.1f} | {high:.1f} |")
    return lines


def policy_config() -> dict[str, Any]:
    """Config of the bundled policy's head, with the number of embodiments that `benches.peers` expects."""
    file = saccade.demo_checkpoint() / "config.json"
    config: dict[str, Any] = json.loads(file.read_text())["action_head_cfg"]
    return config | {"max_num_embodiments": inputs.NUM_EMBODIMENTS}


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benches.latency",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "sections", nargs="*", metavar="SECTION", help="one or more of " + ", ".join(SECTIONS) + "; or report"
    )
    parser.add_argument("--threads", type=int, default=2, help="threads of every head (default 2)")
    parser.add_argument("--busy", type=int, help="busy processes (default: the cores)")
    parser.add_argument("--chunks", type=int, default=200, help="loaded: chunks under load (default 200)")
    parser.add_argument(
        "--chunks-a-turn", type=int, default=10, help="loaded: consecutive chunks per turn (default 10)"
    )
    parser.add_argument("--rounds", type=int, default=9, help="rounds of the other sections (default 9)")
    parser.add_argument("--contenders", nargs="+", choices=CONTENDERS, metavar="NAME", help="instead of all")
    parser.add_argument("--size", choices=("full", "small"), default="full", help="small: for a quick trial")
    parser.add_argument(
        "--work", type=Path, default=Path("out/latency"), help="weights and results (default out/latency)"
    )
    args = parser.parse_args()
    if args.sections == ["report"]:
        args.sections = []
    elif not args.sections:
        args.sections = list(SECTIONS)
    if unknown := set(args.sections) - set(SECTIONS):
        parser.error(f"expected sections of {', '.join(SECTIONS)}, got {', '.join(sorted(unknown))}")
    return args


def main() -> None:
    """Measures and prints."""
    args = parse()
    measures = {"loaded": loaded, "callers": callers, "small": small, "overhead": overhead}
    tables = {
        "loaded": loaded_table,
        "callers": callers_table,
        "small": small_table,
        "overhead": overhead_table,
    }
    results = args.work / "results.json"
    report: Report = json.loads(results.read_text()) if results.exists() else {}
    for section in args.sections:
        measured = measures[section](args, report.get(section, {}))
        report |= {section: measured, "machine": machine.describe()}
        write_text(results, json.dumps(report))
    if not report:
        raise SystemExit(f"latency: {results} does not exist yet; run a section first")
    described = report["machine"]
    print(
        f"{described['cpu']} ({described['family']}), {described['cores']} cores, "
        f"Linux {described['kernel']}; saccade at {described['commit']} ({described['isa']}), "
        f"torch {described['versions']['torch']}."
    )
    for section in SECTIONS:
        if section in report:
            print("\n" + "\n".join(tables[section](report[section])))


if __name__ == "__main__":
    main()
