"""`saccade quantize`: writes a checkpoint with int8 or int4 weights."""

from __future__ import annotations

import argparse

from saccade.cli.copying import add_copy_arguments, copy, print_report

HELP = "write a checkpoint with int8 or int4 weights"

EPILOG = """\
The weights X.weight of the attention and feed-forward layers of all blocks become int8, or with --to int4 two
in a byte, with a float32 scale for each output in X.weight_scale: those of the head, and those of the
backbone unless --keep-backbone or --head-only is given. All other tensors are copied bit for bit, and so are
the other files of the checkpoint, such as statistics, processors and tokenizers. Policy.from_pretrained(DIR,
precision="int8") gives the same bits as loading CHECKPOINT at int8, and so with int4. The other precisions
load it too, with the dequantized weights. docs/precision.md says how much they change actions.

examples:
  saccade quantize GR00T-N1.5-3B/ --out GR00T-N1.5-3B-int8
  saccade quantize GR00T-N1.5-3B/ --to int4 --out GR00T-N1.5-3B-int4
  saccade quantize GR00T-N1.5-3B/ --out head-int8 --head-only --json
  saccade quantize policy.safetensors --config config.json --out policy-int8 --force
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EPILOG
    add_copy_arguments(parser)
    parser.add_argument(
        "--to", choices=("int8", "int4"), default="int8", help="of the weights (default: int8)"
    )
    parser.add_argument("--head-only", action="store_true", help="leave out the tensors outside the head")
    parser.add_argument(
        "--keep-backbone", action="store_true", help="copy the backbone's tensors as they are"
    )


def run(args: argparse.Namespace) -> int:
    """Writes the copy and reports what it contains."""
    from saccade.checkpoints import quantize

    chosen = {"to": args.to, "head_only": args.head_only, "keep_backbone": args.keep_backbone}
    report = copy(quantize, "quantizing", args, **chosen)
    lines = [
        f"{args.out}: {report.num_quantized} weights in {args.to}, {report.num_copied} tensors copied, "
        f"{report.num_dropped} left out; the head has {report.head_bytes_after / 1e6:.1f} MB "
        f"(was {report.head_bytes_before / 1e6:.1f} MB)"
    ]
    if report.num_quantized_backbone:
        before, after = (size / 1e6 for size in (report.backbone_bytes_before, report.backbone_bytes_after))
        lines.append(f"the backbone has {after:.1f} MB (was {before:.1f} MB)")
    elif report.backbone_copied is not None:
        lines.append(f"tensors outside the head were copied as they are: {report.backbone_copied}")
    return print_report(args, report, lines)
