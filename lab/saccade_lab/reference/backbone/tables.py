"""Tables of learned rows."""

import torch
from torch import nn


def embedding(num_rows: int, width: int) -> nn.Embedding:
    """As ``nn.Embedding(num_rows, width)``, whose initialisation imports torch's compiler on ``"meta"``."""
    return nn.Embedding(num_rows, width, _weight=torch.randn(num_rows, width))
