"""How large the encoded actions are before training, beside their positions, by width and initial deviation.

    python studies/why-32/initial_scale.py

The actions are normal noise, as at the beginning of a chunk. Their part of a row is what changes when other
noise goes in; the positions of the rows are drawn with 0.02. The last column is what the decoder makes of
the actions' part when rows go straight into it. All three are standard deviations.
"""

from __future__ import annotations

import torch

from saccade_lab.reference.layers import TABLE_STD, ActionEncoder, CategoryMlp
from saccade_lab.training.learner import scale_categories
from saccade_lab.training.settings import CATEGORY_STD, RELEASED_WIDTH, released_std
from why_32.plan import BASE

CHUNKS, HORIZON, DRAWS = 64, 16, 16
ACTION_DIM, RELEASED_ACTION_DIM = 4, 32
HIDDEN = 1024  # of the decoder in GR00T N1.5


@torch.no_grad()
def scales(width: int, hidden: int, action_dim: int, std: float) -> tuple[float, float]:
    """The part of the actions in their rows, and in what the decoder makes of them."""
    rows, decoded = [], []
    for seed in range(DRAWS):
        torch.manual_seed(seed)
        encoder = ActionEncoder(1, action_dim, width)
        decoder = CategoryMlp(1, width, hidden, action_dim)
        for module in (encoder, decoder):
            scale_categories(module, std)
        noise = torch.randn(CHUNKS, HORIZON, action_dim)
        found = encoder(noise, torch.zeros(CHUNKS, dtype=torch.long), 0)  # (chunks, horizon, width)
        rows.append(found.std(dim=0).mean())
        decoded.append(decoder(found, 0).std(dim=0).mean())
    return float(torch.stack(rows).mean()), float(torch.stack(decoded).mean())


def main() -> None:
    """Prints a table in Markdown."""
    print("| width | action dimensions | deviation | actions in a row | positions | after the decoder |")
    print("| --- | --- | --- | --- | --- | --- |")
    for width, hidden, action_dim, std in (
        (RELEASED_WIDTH, HIDDEN, RELEASED_ACTION_DIM, CATEGORY_STD),
        (RELEASED_WIDTH, HIDDEN, ACTION_DIM, CATEGORY_STD),
        (BASE.width, BASE.width, ACTION_DIM, CATEGORY_STD),
        (BASE.width, BASE.width, ACTION_DIM, released_std(BASE.width)),
    ):
        row, decoded = scales(width, hidden, action_dim, std)
        print(f"| {width:,} | {action_dim} | {std:.3f} | {row:.4f} | {TABLE_STD} | {decoded:.1e} |")


if __name__ == "__main__":
    main()
