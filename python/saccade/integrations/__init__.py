"""Other programs' policies, with saccade's head in the place of their own. Needs torch, which they have."""

from saccade.integrations.accelerated import Accelerated, accelerate

__all__ = ["Accelerated", "accelerate"]
