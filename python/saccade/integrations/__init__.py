"""Runs the action heads of other programs' policies in saccade. Needs torch, as these policies do."""

from saccade._internal.extras import SACCADE

SACCADE.require("torch")

from saccade.integrations.accelerated import Accelerated, accelerate  # noqa: E402

__all__ = ["Accelerated", "accelerate"]
