"""`saccade attention`: what the rows of the action head look at, as a sheet, a page and numbers."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saccade.cli import EXIT_OK, UsageError

if TYPE_CHECKING:
    from saccade.config import HeadConfig
    from saccade.head import ActionHead
    from saccade.maps.occlusion import Occlusion
    from saccade.maps.record import Maps
    from saccade.maps.view import View

HELP = "show what the rows of the action head look at"

EPILOG = """\
The observation is one of the simulator (--task, --seed, --after) or one of a file of backbone features.

A file is .npz or .safetensors with backbone_features (batch, T_vl, context_dim), state (batch, state_dim) and
embodiment_id, as the head takes them; it may hold noise (batch, horizon, action_dim), input_ids, image_mask,
attention_mask (batch, T_vl), images (batch, cameras, H, W, 3) uint8 and tokens (batch, T_vl) strings
(in .safetensors: a JSON list in the metadata).

Where the image tokens are is told by --layout, else by input_ids, else by image_mask. A layout is a list of
parts in the order of their positions, KIND:SIZE or KIND:SIZE=NAME. KIND is image, text, special or pad; SIZE
is ROWSxCOLUMNS for image, a number for the others, and * once for what is left:
  text:20,image:16x16=left,special:1=</img>,text:*

OUT receives sheet.png (means over heads and Euler steps), page.html (one file, opens without a network: pick
block, step, head, token and camera) and attention.json (mass, entropy, overlap, occlusion).

A map says what is read, not what matters; the occlusion map beside it says what the actions depend on.

examples:
  saccade attention --task push --seed 3
  saccade attention out/train/policy --task reach --after 24 --blocks 0,2 --steps 3
  saccade attention checkpoint/ --features step.npz --heads 0,5,12
  saccade attention checkpoint/ --features step.safetensors --layout "text:20,image:16x16,text:*" --json
"""

# Maps shown head by head are embedded in the page, two bytes a probability. Without a limit the page of a
# full-size checkpoint would grow to tens of megabytes; beyond this only named heads are shown one by one.
MAX_PROBABILITIES = 500_000

WIDTH = 160  # letters of a table in a file or a pipe, where there is no edge to keep to


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments."""
    parser.epilog = EPILOG
    parser.add_argument(
        "checkpoint",
        nargs="?",
        type=Path,
        help="directory or .safetensors file (default: the shipped policy)",
    )
    parser.add_argument("--config", type=Path, help="the head's config (default: config.json beside it)")
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        help="of the task's layout, words and noise; of the noise, if a file has none (default: 0)",
    )
    simulator = parser.add_argument_group("an observation of the simulator")
    simulator.add_argument("--task", metavar="NAME", help="task (default: push, if it knows it)")
    simulator.add_argument(
        "--after", type=int, default=0, metavar="K", help="control steps before it looks (default: 0)"
    )
    file = parser.add_argument_group("an observation of a file")
    file.add_argument("--features", type=Path, metavar="FILE", help="backbone features, .npz or .safetensors")
    file.add_argument("--row", type=int, default=0, help="which observation of the file (default: 0)")
    file.add_argument("--layout", metavar="PARTS", help="where the image tokens are, see below")
    file.add_argument("--grid", metavar="RxC", help="patches of a picture (default: 16x16 with input_ids)")
    file.add_argument(
        "--image-token-index", type=int, metavar="ID", help="image token in input_ids (default: 151669)"
    )
    maps = parser.add_argument_group("maps")
    maps.add_argument("--blocks", metavar="N,...", help="blocks (default: all)")
    maps.add_argument("--steps", metavar="N,...", help="Euler steps (default: all)")
    maps.add_argument(
        "--heads",
        metavar="N,...",
        help="heads to show one by one, and to take the mean over; mean: only the mean of all "
        "(default: all, or their mean where that is too much for a page)",
    )
    maps.add_argument(
        "--cell", type=int, metavar="N", help="occlude N x N patches at once (default: at most 8 x 8 cells)"
    )
    parser.add_argument("--threads", type=int, help="threads of the action head (default: the engine's own)")
    parser.add_argument(
        "--out", type=Path, default=Path("out/attention"), help="where results go (default: out/attention)"
    )
    parser.add_argument("--json", action="store_true", help="print attention.json instead of a table")


def run(args: argparse.Namespace) -> int:
    """Checks everything that can be wrong, then looks, measures and writes."""
    from rich.console import Console

    from saccade._files import writable_directory, write_json
    from saccade.maps.page import write_page
    from saccade.maps.sheet import write_sheet

    maps = look(args)
    writable_directory(args.out)
    with Console(stderr=True).status("numbers, sheet and page"):  # 21 s with 16 blocks, 32 heads, T_vl 825
        record = maps.to_dict()
        write_sheet(maps, args.out / "sheet.png")
        write_page(maps, args.out / "page.html")
        write_json(args.out / "attention.json", record)
    if args.json:
        print(json.dumps(record, indent=2))
    else:
        show(maps, record, args.out)
    return EXIT_OK


def look(args: argparse.Namespace) -> Maps:
    """Loads the head, takes the observation and computes all that is shown."""
    from saccade._files import checkpoint_identity
    from saccade.head import ActionHead
    from saccade.maps import record
    from saccade.maps.occlusion import cell_for
    from saccade.sim.policy import DEMO_CHECKPOINT

    check(args)
    checkpoint = args.checkpoint or DEMO_CHECKPOINT
    head = ActionHead.load(checkpoint, config=args.config, num_threads=args.threads)
    blocks = record.choose("blocks", numbers("--blocks", args.blocks), head.config.num_layers)
    steps = record.choose("steps", numbers("--steps", args.steps), head.config.num_steps)
    named = args.heads not in (None, "mean")
    heads = record.choose("heads", numbers("--heads", args.heads) if named else None, head.config.num_heads)
    view = take(args, checkpoint, head.config)
    few = probabilities(head.config, view, len(blocks), len(steps)) <= MAX_PROBABILITIES
    shown = heads if named or (args.heads is None and few) else ()
    selection = record.Selection(blocks, steps, heads, shown)
    cell = cell_for(view.layout, args.cell)
    rows, attention = record.look(head, view, selection)
    redrawn = None
    if head.config.num_future_tokens:
        tokens = record.random_tokens(head.future_tokens, seed=0)
        redrawn = record.look_redrawn(head, view, selection, tokens)
    return record.Maps(
        checkpoint=checkpoint_identity(checkpoint),
        config=head.config,
        view=view,
        selection=selection,
        rows=rows,
        attention=attention,
        redrawn=redrawn,
        occlusion=occlude(head, view, cell) if view.layout.cameras else None,
    )


def check(args: argparse.Namespace) -> None:
    """Raises `UsageError` for arguments that contradict each other or are out of range on their own."""
    if args.threads is not None and args.threads < 1:
        raise UsageError(f"--threads: given {args.threads}, expected at least 1")
    if args.after < 0:
        raise UsageError(f"--after: given {args.after}, expected at least 0")
    if args.seed < 0:
        raise UsageError(f"--seed: given {args.seed}, expected at least 0")
    if args.out.exists() and not args.out.is_dir():
        raise UsageError(f"--out: {args.out} is no directory")
    if args.features is not None and (args.task is not None or args.after):
        raise UsageError("--features, --task: expected one observation, of a file or of the simulator")
    if args.features is None:
        given = {"--layout": args.layout, "--grid": args.grid, "--image-token-index": args.image_token_index}
        wrong = [name for name, value in given.items() if value is not None] + ["--row"] * bool(args.row)
        if wrong:
            raise UsageError(f"{', '.join(wrong)}: only with --features")


def numbers(name: str, text: str | None) -> tuple[int, ...] | None:
    """`"0,2"` to numbers; None stays None."""
    if text is None:
        return None
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"{name}: given {text!r}, expected numbers with commas between them") from None


def probabilities(config: HeadConfig, view: View, blocks: int, steps: int) -> int:
    """About how many there are in the maps of all heads."""
    rows = 1 + config.num_future_tokens + config.action_horizon
    return blocks * steps * config.num_heads * rows * view.layout.num_tokens


def take(args: argparse.Namespace, checkpoint: Path, config: HeadConfig) -> View:
    """The observation that was asked for."""
    from saccade.errors import CheckpointError
    from saccade.maps import layout, view

    if args.features is not None:
        options = view.LayoutOptions(
            text=args.layout,
            grid=None if args.grid is None else layout.parse_grid(args.grid),
            image_token_index=layout.IMAGE_TOKEN_INDEX
            if args.image_token_index is None
            else args.image_token_index,
        )
        return view.from_file(args.features, config, row=args.row, options=options, seed=args.seed)
    from saccade.sim import graphics
    from saccade.sim.policy import Policy, check_trained_on
    from saccade.sim.tasks import check_evaluation_seeds, find_task

    check_evaluation_seeds(args.seed, 1)
    try:
        policy = Policy.load(checkpoint, num_threads=args.threads)
    except (CheckpointError, FileNotFoundError) as error:
        raise UsageError(f"{error}; for another checkpoint: --features FILE") from None
    known = policy.config.tasks
    task = find_task(args.task or ("push" if "push" in known else known[0])).name
    check_trained_on(policy, [task])
    graphics.check()
    return view.from_simulator(policy, task, args.seed, args.after)


def occlude(head: ActionHead, view: View, cell: int) -> Occlusion:
    """The occlusion map, behind a progress bar."""
    import numpy as np
    from rich.console import Console
    from rich.progress import Progress

    from saccade.maps.occlusion import measure, places_of

    observation = view.observation
    context = observation.encode(head)

    def whole(count: int) -> Any:
        chunks = head.sample(context, observation.state, observation.embodiment_id, seed=0, num_samples=count)
        return np.asarray(chunks)[0]

    with Progress(console=Console(stderr=True), transient=True) as progress:
        bar = progress.add_task("occlusion", total=len(places_of(view.layout, cell)))
        return measure(
            head,
            view.layout,
            view.occluder,
            whole,
            cell=cell,
            on_done=lambda done: progress.update(bar, completed=done),
        )


def show(maps: Maps, record: dict[str, Any], out: Path) -> None:
    """Prints where attention goes, and where the files are."""
    from rich import box
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from saccade.maps.sheet import NO_FUTURE, NO_IMAGES

    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)
    console.print(maps.view.title, style="bold", markup=False, soft_wrap=True)
    entries = [entry for entry in record["summaries"] if entry["head"] == "mean"]
    for reads, blocks in (("vl", maps.cross_blocks()), ("rows", maps.self_blocks())):
        if not blocks:
            continue
        parts = list(maps.parts(blocks[0]))
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
        for heading in (f"reads {reads}", "rows"):
            table.add_column(heading, no_wrap=True)
        for heading in (*parts, "keys", "distinct"):
            table.add_column(escape(heading), justify="right", no_wrap=True)
        for block in blocks:
            for group in maps.rows:
                found = [e for e in entries if e["block"] == block and e["group"] == group]
                table.add_row(f"block {block}", group, *cells(found, parts))
        console.print(table)
    console.print(
        "attention in %, means over heads and Euler steps; keys: exp(entropy) of a row in one head; "
        "distinct: effective number of distinct maps in one head",
        style="dim",
        soft_wrap=True,
    )
    for missing, message in (
        (not maps.num_future_tokens, NO_FUTURE),
        (not maps.view.layout.cameras, NO_IMAGES),
    ):
        if missing:
            console.print(message, soft_wrap=True)
    console.print(maps.caveat, style="italic", soft_wrap=True)
    for label, name in (("sheet", "sheet.png"), ("page", "page.html"), ("numbers", "attention.json")):
        console.print(f"{label:8} {out / name}", soft_wrap=True, highlight=False, markup=False)


def cells(entries: Sequence[dict[str, Any]], parts: Sequence[str]) -> list[str]:
    """One row of the table: means over the Euler steps."""
    import numpy as np

    masses = [100 * np.mean([entry["mass"][part] for entry in entries]) for part in parts]
    spread = np.exp(np.mean([entry["per_head"]["entropy"] for entry in entries]))
    overlaps = [entry["per_head"]["overlap"] for entry in entries]
    distinct = "–" if overlaps[0] is None else f"{np.mean([found['distinct'] for found in overlaps]):.2f}"
    return [*(f"{mass:.1f}" for mass in masses), f"{spread:.1f}", distinct]
