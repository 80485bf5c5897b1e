"""How large the encoded actions are before training, beside their positions, by width and initial deviation.

    python studies/answer/initial_scale.py

The actions are normal noise, as at the beginning of a chunk. Their part of a row is what changes when other
noise goes in; the positions of the rows are drawn with 0.02. The last column is what the decoder makes of
the actions' part when rows go straight into it. All three are standard deviations.
"""

from __future__ import annotations

import torch

from saccade.reference.layers import TABLE_STD, ActionEncoder, CategoryMlp
from saccade.sim.training_settings import CATEGORY_STD, RELEASED_WIDTH, released_std
from saccade.study.answer.plan import BASE

CHUNKS, HORIZON, ACTION_DIM, DRAWS = 64, 16, 4, 16
HIDDEN = 1024  # of the decoder in GR00T N1.5


@torch.no_grad()
def scales(width: int, hidden: int, std: float) -> tuple[float, float]:
    """The part of the actions in their rows, and in what the decoder makes of them."""
    rows, decoded = [], []
    for seed in range(DRAWS):
        torch.manual_seed(seed)
        encoder = ActionEncoder(1, ACTION_DIM, width)
        decoder = CategoryMlp(1, width, hidden, ACTION_DIM)
        for module in (encoder, decoder):
            for parameter in module.parameters():
                parameter.mul_(std / CATEGORY_STD)
        noise = torch.randn(CHUNKS, HORIZON, ACTION_DIM)
        found = encoder(noise, torch.zeros(CHUNKS, dtype=torch.long), 0)  # (chunks, horizon, width)
        rows.append(found.std(dim=0).mean())
        decoded.append(decoder(found, 0).std(dim=0).mean())
    return float(torch.stack(rows).mean()), float(torch.stack(decoded).mean())


def main() -> None:
    """Prints a table in Markdown."""
    print("| width | deviation | part of the actions in a row | of the positions | after the decoder |")
    print("| --- | --- | --- | --- | --- |")
    for width, hidden, std in (
        (RELEASED_WIDTH, HIDDEN, CATEGORY_STD),
        (BASE.width, BASE.width, CATEGORY_STD),
        (BASE.width, BASE.width, released_std(BASE.width)),
    ):
        row, decoded = scales(width, hidden, std)
        print(f"| {width} | {std:.4f} | {row:.4f} | {TABLE_STD} | {decoded:.1e} |")


if __name__ == "__main__":
    main()
