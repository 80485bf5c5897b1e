"""A study with your own condition and metric: what happens without the two longest future tokens?

    python examples/own_study.py                                               the bundled policy, simulated
    python examples/own_study.py --checkpoint CHECKPOINT --features FILE.npz   any checkpoint, on a recording

The condition is compared with the unchanged head on the same episodes and noise. Results are kept in --out,
so a later run with more episodes measures only the new ones. `saccade study report OUT` writes a report.
Needs saccade_lab with its extra `study`.
"""

import argparse
from pathlib import Path

import numpy as np
import numpy.typing as npt

from saccade.head.intervention import Intervention
from saccade_lab.study.arms import METRICS, Arm, Metric
from saccade_lab.study.questions.cuts import Cuts
from saccade_lab.study.recording import Recording
from saccade_lab.study.run import run
from saccade_lab.study.source import Source
from saccade_lab.study.table import provenance_path, read_provenance

Float32Array = npt.NDArray[np.float32]
REMOVED = 2


def without_longest(tokens: Float32Array, rng: np.random.Generator) -> Intervention:
    """An intervention that removes the longest of the learned future tokens, `(N, width)`."""
    kept = np.sort(np.argsort(np.linalg.norm(tokens, axis=1))[:-REMOVED])
    return Intervention(future_tokens=tokens[kept])


def first_action(before: Float32Array, after: Float32Array) -> float:
    """Mean change of the first action; both arrays are `(observations, draws, horizon, action_dim)`."""
    return float(np.abs(after - before)[:, :, 0].mean())


ARM = Arm(
    "without-longest",
    label=f"without the {REMOVED} longest future tokens",
    about="The future tokens with the largest norm are removed; the others stay as they are.",
    intervention=without_longest,
    settings={"removed": REMOVED},  # part of the cell's name, so another number is a new measurement
)


def source_of(args: argparse.Namespace) -> Source:
    """The recording if one is given, otherwise episodes of a policy in the simulator."""
    if args.features is not None:
        return Recording(str(args.checkpoint), str(args.features))
    from saccade_lab.study.simulator import simulator  # needs the extra `sim` and OpenGL

    return simulator(args.checkpoint, ["button-press-topdown"], range(args.episodes))


def main() -> None:
    """Measures the arm and prints the conclusions."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--checkpoint", type=Path, help="default: the bundled policy")
    parser.add_argument("--features", type=Path, help="recorded observations for the checkpoint")
    parser.add_argument("--episodes", type=int, default=3, help="in the simulator (default: 3)")
    parser.add_argument("--out", type=Path, default=Path("out/own-study"))
    args = parser.parse_args()
    if args.features is not None and args.checkpoint is None:
        parser.error("--features needs a --checkpoint")

    study = Cuts(source_of(args), arms=(ARM,), metrics=(*METRICS, Metric("first_action", first_action)))
    table = run(study, args.out)
    for line in Cuts.summarise(table, read_provenance(provenance_path(args.out, Cuts.name))).concluded:
        print(f"- {line}")
    moved = table[table["arm"] == ARM.name]["first_action"]
    print(f"The first action moves by {moved.mean():.4f} on average (at most {moved.max():.4f}).")


if __name__ == "__main__":
    main()
