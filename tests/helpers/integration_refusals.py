"""What `accelerate` and an accelerated head must refuse: checks for any torch head with `get_action`."""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call, operator"

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

import saccade
from saccade.integrations import accelerate
from tests.helpers.integration_cases import Case, call, inputs


def refused(head: nn.Module, match: str) -> None:
    """Checks that `accelerate` refuses the head and leaves it as it is."""
    with pytest.raises(saccade.InputError, match=match):
        accelerate(head)
    assert "get_action" not in vars(head)


def check_refusals(case: Case) -> None:
    """Uses that saccade cannot follow are errors, before and after `accelerate`."""
    check_modes_that_are_refused(case)
    check_changes_that_are_refused(case)


def check_modes_that_are_refused(case: Case) -> None:
    """Training mode, hooks, gradients, and another `get_action`."""
    head, given = case.head, inputs(case)
    block = head.model.transformer_blocks[0]

    handle = accelerate(head)
    head.train()
    with pytest.raises(saccade.InputError, match="training mode"):
        call(case, given)
    handle.restore()
    refused(head, "training mode")
    head.eval()

    handle = accelerate(head)
    hook = block.register_forward_hook(lambda *arguments: None)
    with pytest.raises(saccade.InputError, match="hooks"):
        call(case, given)
    handle.restore()
    refused(head, "hooks")
    hook.remove()

    with accelerate(head) as handle:
        wanting = (
            {**given[0], "backbone_features": given[0]["backbone_features"].clone().requires_grad_()},
            given[1],
        )
        with pytest.raises(saccade.InputError, match="gradient"):
            call(case, wanting)
        with torch.no_grad():
            call(case, wanting)
        with pytest.raises(TypeError):
            head.get_action(*given, options={}, other=1)
        # Other code replaces `get_action`.
        head.get_action = lambda *arguments: handle(*arguments)
        with pytest.raises(saccade.InputError, match="replaced since"):
            handle.restore()
        del head.get_action
        head.get_action = handle

    head.get_action = lambda *arguments: None
    with pytest.raises(saccade.InputError, match="replaced by"):
        accelerate(head)
    del head.get_action


def check_changes_that_are_refused(case: Case) -> None:
    """A replaced or compiled module, another dtype, and other code under the same names."""
    head = case.head
    block = head.model.transformer_blocks[0]

    block.forward = lambda *arguments: None
    refused(head, "forward of model.transformer_blocks.0")
    del block.forward

    handle = accelerate(head)
    block.forward = lambda *arguments: None
    with pytest.raises(
        saccade.InputError, match=r"forward of model\.transformer_blocks\.0 has been replaced"
    ):
        call(case, inputs(case, batch=1))
    del block.forward
    handle.restore()

    with pytest.raises(saccade.InputError, match=r"compiled by torch\.compile"):
        accelerate(torch.compile(head))

    compiled = torch.compile(block)
    head.model.transformer_blocks[0] = compiled
    refused(head, "torch.compile")
    head.model.transformer_blocks[0] = block

    head.double()
    refused(head, "float64")
    head.float()

    # Other code under the same names and shapes is found by running it.
    activation = type(block.ff.net[0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(activation, "gelu", lambda self, gate: torch.relu(gate))
        refused(head, "its actions differ")
    drawn = type(head).process_backbone_output

    def drawing(self: nn.Module, backbone_output: Any) -> Any:
        torch.randn(1)
        return drawn(self, backbone_output)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(head), "process_backbone_output", drawing)
        refused(head, "random numbers")
    accelerate(head).restore()
