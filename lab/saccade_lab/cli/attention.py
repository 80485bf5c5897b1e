"""``saccade attention``: shows what the rows of the action head attend to, as a sheet, a page and numbers."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saccade._internal import flags as arguments
from saccade._internal.files import write_json
from saccade._internal.flags import UsageError, flags_given
from saccade.cli import EXIT_OK, output
from saccade_lab import flags as lab_flags
from saccade_lab.extras import LAB, require
from saccade_lab.files import loading_identity, writable_directory

if TYPE_CHECKING:
    from saccade.head.config import HeadConfig
    from saccade.head.head import ActionHead
    from saccade_lab.maps.occlusion import Occlusion
    from saccade_lab.maps.record import Maps
    from saccade_lab.maps.view import View

HELP = "show what the rows of the action head attend to"
EXTRAS = LAB

EPILOG = """\
The observation comes from the simulator (--task, --seed, --after), from images (--frames) or from a file of
backbone features (--features).

Images need a whole checkpoint, with backbone and tokenizer. DIR holds an image of each camera, named
after it (front.png), and state.json; or a folder of these for each observation, of which --row chooses one.
Without state.json and --state the state is in the middle of the robot's range. `saccade inspect` lists the
cameras.

The file of features is .npz or .safetensors with backbone_features (batch, T_vl, context_dim), state (batch,
state_dim) and embodiment_id, as ActionHead takes them. It may contain noise (batch, horizon, action_dim),
input_ids, image_mask, attention_mask (batch, T_vl), images (batch, cameras, H, W, 3) uint8 and tokens (batch,
T_vl) strings (in .safetensors a JSON list in the metadata).

The positions of image tokens are given by --layout, else by input_ids, else by image_mask. A layout lists the
parts in the order of their positions, KIND:SIZE or KIND:SIZE=NAME. KIND is image, text, special or pad. SIZE
is ROWSxCOLUMNS for image and a number for the others; one part may have * for all remaining positions:
  text:20,image:16x16=left,special:1=</img>,text:*

DIR receives sheet.png (means over heads and Euler steps), page.html (one file that needs no network; choose
block, step, head, token and camera) and attention.json (mass, entropy, overlap, occlusion).

A map shows what a row attends to, not what matters; the occlusion map shows what the actions depend on.

examples:
  saccade attention --task push --seed 3
  saccade attention --checkpoint out/policy --task reach --after 24 --blocks 0,2 --steps 3
  saccade attention --checkpoint GR00T-N1.5-3B/ --frames table/ --instruction "pick up the pear" \\
    --embodiment gr1 --data-config fourier_gr1_arms_only
  saccade attention --checkpoint checkpoint/ --features step.npz --heads 0,5,12
  saccade attention --checkpoint checkpoint/ --features step.safetensors \\
    --layout "text:20,image:16x16,text:*" --json
"""

# Maps of single heads are embedded in the page, two bytes per probability. Without a limit the page of a
# full-size checkpoint would have tens of megabytes. Above it, only heads given by --heads are shown.
MAX_PROBABILITIES = 500_000

WIDTH = 160  # characters in a line where the output is not a terminal


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments."""
    parser.epilog = EPILOG
    lab_flags.add_checkpoint(parser, "directory or .safetensors file (default: the bundled policy)")
    arguments.add_config(parser)
    arguments.add_seed(
        parser,
        "seed of the task's layout, instruction and noise; with images or a file without noise, of the noise",
    )
    arguments.add_integer(parser, "--row", minimum=0, help="which observation, of several (default: 0)")
    simulator = parser.add_argument_group("an observation from the simulator")
    simulator.add_argument(
        "--task", metavar="NAME", help="task (default: push, or the policy's first task if it lacks push)"
    )
    arguments.add_integer(
        simulator, "--after", minimum=0, help="control steps before the observation (default: 0)"
    )
    lab_flags.add_frames(parser)
    file = parser.add_argument_group("an observation from a file")
    arguments.add_features(file, "backbone features, .npz or .safetensors")
    file.add_argument("--layout", metavar="PARTS", help="positions of the image tokens, see below")
    file.add_argument(
        "--grid",
        metavar="RxC",
        help="rows and columns of patches of an image (default: 16x16 with input_ids)",
    )
    file.add_argument(
        "--image-token-index",
        type=int,
        metavar="ID",
        help="the image token in input_ids (default: 151669)",
    )
    maps = parser.add_argument_group("maps")
    arguments.add_list(maps, "--blocks", item=int, metavar="N", help="blocks (default: all)")
    arguments.add_list(maps, "--steps", item=int, metavar="N", help="Euler steps (default: all)")
    arguments.add_list(
        maps,
        "--heads",
        item=head,
        metavar="N",
        help="heads to show one by one and to average over, or mean for the mean of all heads only (default: "
        "all, or their mean where all would be too much for a page)",
    )
    arguments.add_integer(
        maps, "--cell", help="occlude N x N patches at a time (default: at most 8 x 8 cells)"
    )
    arguments.add_num_threads(parser)
    arguments.add_out(parser, "out/attention")
    arguments.add_json(parser, "print attention.json instead of a table")


def head(word: str) -> int | str:
    """An item of ``--heads``."""
    return word if word == "mean" else int(word)


def run(args: argparse.Namespace) -> int:
    """Checks everything that can be wrong, then computes and writes the maps."""
    check(args)
    require("attention" if args.frames is None else "attention --frames")
    from saccade_lab.maps.page import write_page
    from saccade_lab.maps.sheet import write_sheet

    maps = compute(args)
    writable_directory(args.out)
    # 21 s with 16 blocks, 32 heads, T_vl 825
    with output.console(stderr=True).status("numbers, sheet and page"):
        record = maps.to_dict()
        write_sheet(maps, args.out / "sheet.png")
        write_page(maps, args.out / "page.html")
        write_json(args.out / "attention.json", record)
    if args.json:
        output.print_json(record, indent=2)
    else:
        show(maps, record, args.out)
    return EXIT_OK


def compute(args: argparse.Namespace) -> Maps:
    """Loads the head and the observation, and computes everything that is shown."""
    from saccade._internal.hub import resolve
    from saccade_lab.files import checkpoint_identity

    checkpoint = args.checkpoint
    if checkpoint is None:
        from saccade_lab.sim.policy import DEMO_CHECKPOINT as checkpoint
    checkpoint = resolve(checkpoint)
    if args.features is not None:
        head, view = take_features(args, checkpoint)
    elif args.frames is not None:
        head, view = take_frames(args, checkpoint)
    else:
        head, view = take_simulator(args, checkpoint)
    return maps_of(args, checkpoint_identity(checkpoint), head, view)


def maps_of(args: argparse.Namespace, checkpoint: dict[str, str], head: ActionHead, view: View) -> Maps:
    """Everything that is shown of an observation."""
    from saccade_lab.maps import record
    from saccade_lab.maps.occlusion import cell_for

    blocks = lab_flags.indices("--blocks", args.blocks, head.config.num_layers)
    steps = lab_flags.indices("--steps", args.steps, head.config.num_steps)
    named = args.heads not in (None, ("mean",))
    heads = lab_flags.indices("--heads", args.heads if named else None, head.config.num_heads)
    few = probabilities(head.config, view, len(blocks), len(steps)) <= MAX_PROBABILITIES
    shown = heads if named or (args.heads is None and few) else ()
    selection = record.Selection(blocks, steps, heads, shown)
    cell = cell_for(view.layout, args.cell)
    rows, attention = record.attention_maps(head, view, selection)
    redrawn = None
    if head.config.num_future_tokens:
        tokens = record.random_tokens(head.future_tokens, seed=0)
        redrawn = record.redrawn_maps(head, view, selection, tokens)
    return record.Maps(
        checkpoint=checkpoint,
        config=head.config,
        view=view,
        selection=selection,
        rows=rows,
        attention=attention,
        redrawn=redrawn,
        occlusion=occlude(head, view, cell) if view.layout.cameras else None,
    )


def check(args: argparse.Namespace) -> None:
    """Raises ``UsageError`` or ``InputError`` for arguments that are wrong whatever the checkpoint is."""
    if args.out.exists() and not args.out.is_dir():
        raise UsageError(f"--out: {args.out} is not a directory")
    if args.heads is not None and "mean" in args.heads and len(args.heads) > 1:
        raise UsageError("--heads: given mean and numbers, expected one or the other")
    if args.task is not None:
        lab_flags.check_known("--task", [args.task], lab_flags.known_tasks())
    of_file = ("layout", "grid", "image_token_index")
    lab_flags.check_frames(args, "features", "task", "after", "config", *of_file)
    if args.features is not None and (args.task is not None or args.after):
        raise UsageError("--features, --task: expected one observation, from a file or from the simulator")
    if args.features is None and args.frames is None:
        from saccade_lab.sim.tasks import check_evaluation_seeds

        check_evaluation_seeds(args.seed, 1)
        if given := flags_given(args, (*of_file, "row")):
            raise UsageError(f"{given}: only with --features{' or --frames' * (given == '--row')}")


def probabilities(config: HeadConfig, view: View, blocks: int, steps: int) -> int:
    """About how many probabilities the maps of all heads contain."""
    return blocks * steps * config.num_heads * config.num_rows * view.layout.num_tokens


def take_features(args: argparse.Namespace, checkpoint: Path) -> tuple[ActionHead, View]:
    """The head of any checkpoint, and the row of a file that the arguments ask for."""
    from saccade.head.head import ActionHead
    from saccade_lab.maps import layout, view

    head = ActionHead.from_pretrained(checkpoint, config=args.config, num_threads=args.num_threads)
    options = view.LayoutOptions(
        text=args.layout,
        grid=None if args.grid is None else layout.parse_grid(args.grid),
        image_token_index=layout.IMAGE_TOKEN_INDEX
        if args.image_token_index is None
        else args.image_token_index,
    )
    found = view.from_file(args.features, head.config, row=args.row or 0, options=options, seed=args.seed)
    return head, found


def take_simulator(args: argparse.Namespace, checkpoint: Path) -> tuple[ActionHead, View]:
    """The head of a policy of the simulator, and what it sees in the episode that the arguments ask for."""
    from saccade.errors import CheckpointError
    from saccade_lab.inside import parts_of
    from saccade_lab.maps.view import from_simulator
    from saccade_lab.sim import graphics
    from saccade_lab.sim.policy import Policy, check_trained_on

    try:
        policy = Policy.from_pretrained(checkpoint, num_threads=args.num_threads)
    except (CheckpointError, FileNotFoundError) as error:
        raise UsageError(f"{error}; for another checkpoint: --frames DIR or --features FILE") from None
    known = policy.config.tasks
    task = args.task or ("push" if "push" in known else known[0])
    check_trained_on(policy, [task])
    graphics.check()
    return parts_of(policy.whole).head, from_simulator(policy, task, args.seed, args.after or 0)


def take_frames(args: argparse.Namespace, checkpoint: Path) -> tuple[ActionHead, View]:
    """The head of a whole checkpoint, and the observation of a directory that the arguments ask for."""
    import numpy as np

    from saccade.observations.pictures import read_frames
    from saccade.policy.policy import Policy
    from saccade_lab.inside import parts_of
    from saccade_lab.maps.view import from_policy

    options = arguments.loading_options(args)
    with output.progress_bar("loading", transient=True):
        policy = Policy.from_pretrained(
            checkpoint,
            precision={"backbone": args.precision or "float32", "head": "float32"},
            **options,
        )
    parts = parts_of(policy)
    recorded = read_frames(args.frames, policy, instruction=args.instruction, state=args.state)
    row = args.row or 0
    if row >= len(recorded):
        raise UsageError(f"--row: given {row}, {args.frames} has observations 0 to {len(recorded) - 1}")
    one = recorded[row]
    robot = policy.normalizer.embodiment or f"embodiment {policy.embodiment_id}"
    view = from_policy(
        policy,
        one.observation,
        rng=np.random.default_rng(args.seed),
        title=f'{one.name}: "{one.instruction}", {robot}',
        source={
            "kind": "frames",
            "observation": one.name,
            "instruction": one.instruction,
            "embodiment_id": policy.embodiment_id,
            "precision": args.precision or "float32",
            "preprocessing": parts.processor.preprocessing,
            **loading_identity(checkpoint, options),
            "noise": f"seed {args.seed}",
        },
    )
    return parts.head, view


def occlude(head: ActionHead, view: View, cell: int) -> Occlusion:
    """The occlusion map, with a progress bar."""
    import numpy as np

    from saccade_lab.maps.occlusion import measure, places_of

    observation = view.observation
    context = observation.encode(head)

    def whole(count: int) -> Any:
        chunks = head.sample(context, observation.state, observation.embodiment_id, seed=0, num_samples=count)
        return np.asarray(chunks)[0]

    total = len(places_of(view.layout, cell))
    with output.progress_bar("occlusion", total, transient=True) as update:
        return measure(head, view.layout, view.occluder, whole, cell=cell, on_done=update)


def show(maps: Maps, record: dict[str, Any], out: Path) -> None:
    """Prints where attention goes, and where the files are."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    from saccade_lab.maps.notes import NO_FUTURE, NO_IMAGES

    console = output.console(width=WIDTH)
    console.print(maps.view.title, style="bold", markup=False, soft_wrap=True)
    entries = [entry for entry in record["summaries"] if entry["head"] == "mean"]
    for reads, blocks in (("vl", maps.cross_blocks()), ("rows", maps.self_blocks())):
        if not blocks:
            continue
        parts = list(maps.parts(blocks[0]))
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
        for heading in (f"attends to {reads}", "rows"):
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
        print(f"{label:8} {out / name}")


def cells(entries: Sequence[dict[str, Any]], parts: Sequence[str]) -> list[str]:
    """One row of the table: means over the Euler steps."""
    import numpy as np

    masses = [100 * np.mean([entry["mass"][part] for entry in entries]) for part in parts]
    spread = np.exp(np.mean([entry["per_head"]["entropy"] for entry in entries]))
    overlaps = [entry["per_head"]["overlap"] for entry in entries]
    distinct = "–" if overlaps[0] is None else f"{np.mean([found['distinct'] for found in overlaps]):.2f}"
    return [*(f"{mass:.1f}" for mass in masses), f"{spread:.1f}", distinct]
