"""The parts of a whole policy, for what looks inside them."""

from __future__ import annotations

from dataclasses import dataclass

from saccade.backbone import Backbone
from saccade.errors import InputError
from saccade.head import ActionHead
from saccade.policy import Policy
from saccade.processor import Processor


@dataclass(frozen=True, eq=False)
class Parts:
    """The parts of a whole policy."""

    head: ActionHead
    backbone: Backbone
    processor: Processor


def parts_of(policy: Policy) -> Parts:
    """The parts of a policy that :meth:`saccade.Policy.load` loaded.

    Raises:
        InputError: It has no backbone or no processor, or its head is not a :class:`saccade.ActionHead`.
    """
    head, backbone, processor = policy.head, policy.backbone, policy.processor
    if backbone is None or processor is None or not isinstance(head, ActionHead):
        raise InputError(f"policy: expected one that saccade.Policy.load loaded, got {policy!r}")
    return Parts(head, backbone, processor)
