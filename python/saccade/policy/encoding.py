"""Step 4 of :meth:`saccade.Policy.act`: the backbone's features, and the context of the action head.

If processor, backbone and head are saccade's own, steps 3 and 4 are one call of the engine.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeGuard, TypeVar

import numpy as np

import saccade._saccade as _saccade
from saccade._internal.arrays import frame, text
from saccade.backbone.backbone import Backbone
from saccade.backbone.features import BackboneFeatures
from saccade.backbone.inputs import BackboneInputs
from saccade.errors import InputError
from saccade.head.context import Context
from saccade.head.head import ActionHead
from saccade.observations import ParsedObservation
from saccade.policy.guidance import Without, named, without_words
from saccade.policy.interfaces import Head, VisionLanguageBackbone
from saccade.policy.preparing import prepare_inputs
from saccade.processor import Processor

Part = TypeVar("Part")


@dataclass(frozen=True, eq=False)
class PolicyContext:
    """Encoded observations of a whole policy. Returned by :meth:`saccade.Policy.encode`.

    The context is immutable and is not stored by the policy. Pass it to :meth:`saccade.Policy.sample` for
    actions, and as ``previous`` with the next observation, so that what did not change is not computed again.

    Attributes:
        context: The head's context: the keys and values of its cross-attention. ``batch`` observations, those
            with fewer tokens than the longest padded, and the padding dropped.
        features: The backbone's features of each observation, a batch of one each.
        without: The same observations without their instructions, for guidance, or None.

    Example:
        >>> import saccade
        >>> def act_twice(policy: saccade.Policy, first: dict, second: dict) -> list:
        ...     context = policy.encode(first)
        ...     actions = [policy.sample(context, first, seed=0)]
        ...     context = policy.encode(second, previous=context)
        ...     return [*actions, policy.sample(context, second, seed=0)]
    """

    context: Context
    features: tuple[BackboneFeatures, ...]
    without: PolicyContext | None = None

    @property
    def batch(self) -> int:
        """Number of observations."""
        return len(self.features)

    @property
    def num_vl_tokens(self) -> int:
        """Number of vision-language tokens of the longest observation."""
        return self.context.num_vl_tokens

    def __repr__(self) -> str:
        return f"<saccade.PolicyContext batch={self.batch} num_vl_tokens={self.num_vl_tokens}>"


def encode_with_and_without(
    parsed: Sequence[ParsedObservation],
    without: Without,
    processor: Processor,
    backbone: VisionLanguageBackbone,
    head: Head,
    previous: PolicyContext | None = None,
) -> PolicyContext:
    """As :func:`encode_observations`, and the observations without their words.

    These take views and the common beginning of the prompt from those with words.
    """
    bare = without_words(parsed, without, processor)
    found = encode_observations(parsed, processor, backbone, head, previous)
    before = getattr(previous, "without", None)
    known = found if before is None else replace(found, features=(*found.features, *before.features))
    with named(without):
        second = encode_observations(bare, processor, backbone, head, known)
    return replace(found, without=second)


def encode_observations(
    parsed: Iterable[ParsedObservation],
    processor: Processor,
    backbone: VisionLanguageBackbone,
    head: Head,
    previous: PolicyContext | None = None,
) -> PolicyContext:
    """The context of each row of observations; ``previous`` as in :meth:`saccade.Policy.encode`."""
    # Others may compute in their own way.
    if not (
        is_own(processor, Processor)
        and is_own(backbone, Backbone)
        and is_own(head, ActionHead)
        and (previous is None or _is_own_context(previous))
    ):
        return encode_features(compute_features(prepare_inputs(parsed, processor), backbone, previous), head)
    observations: list[Any] = []
    names: list[tuple[str, ...]] = []
    for observation in parsed:
        for frames, instruction in zip(observation.frames, observation.instructions, strict=True):
            # Without their names, by which lerobot's processor would sort them: they are in order.
            views = [(None, frame(f"frames[{index}]", one)) for index, one in enumerate(frames.values())]
            told = None if instruction is None else text("instruction", instruction)
            observations.append(((views, True, told), bool(observation.is_plain)))
            names.append(tuple(frames))
    engine = _saccade.Policy(processor._processor, backbone._engine, head._engine)
    held = None if previous is None else (previous.context._held, [one._held for one in previous.features])
    context, features = engine.encode(observations, held)
    found = tuple(BackboneFeatures(one, named) for one, named in zip(features, names, strict=True))
    return PolicyContext(Context(context, False, None), found)


def compute_features(
    inputs: Sequence[BackboneInputs],
    backbone: VisionLanguageBackbone,
    previous: PolicyContext | None = None,
) -> tuple[BackboneFeatures, ...]:
    """The backbone's features of each of its inputs, unchanged views and prompts taken from ``previous``."""
    if previous is not None and not isinstance(previous, PolicyContext):
        raise InputError(f"previous: expected what encode returns, got {type(previous).__name__}")
    return tuple(backbone.encode_many(inputs, previous=() if previous is None else previous.features))


def encode_features(features: Sequence[BackboneFeatures], head: Head) -> PolicyContext:
    """The context of features, each a batch of one of any length."""
    if is_own(head, ActionHead) and all(type(one) is BackboneFeatures for one in features):
        use_torch = len(features) == 1 and features[0]._torch
        held = head._engine.encode_features([one._held for one in features])
        return PolicyContext(Context(held, use_torch, None), tuple(features))
    # Shorter ones are padded, and their padding is dropped, which gives the bits without padding.
    lengths = [one.backbone_features.shape[1] for one in features]
    longest = max(lengths)
    dropped = np.arange(longest) >= np.array(lengths)[:, None]
    context = head.encode(
        _joined([pad_tokens(one.backbone_features, longest) for one in features]),
        image_mask=_joined([pad_tokens(one.image_mask, longest) for one in features]),
        drop_vl=dropped if dropped.any() else None,
    )
    return PolicyContext(context, tuple(features))


def is_own(part: object, kind: type[Part]) -> TypeGuard[Part]:
    """Whether a part is saccade's: not of a subclass, and with no method replaced on the object."""
    return type(part) is kind and not any(map(callable, vars(part).values()))


def _is_own_context(previous: Any) -> bool:
    parts = (previous.context, *previous.features) if isinstance(previous, PolicyContext) else (previous,)
    return all(type(part) in (Context, BackboneFeatures) for part in parts)


def pad_tokens(array: Any, length: int) -> Any:
    """``(1, T, ...)`` zero-padded to ``(1, length, ...)``."""
    missing = length - array.shape[1]
    if missing == 0:
        return array
    return np.concatenate([array, np.zeros((1, missing, *array.shape[2:]), array.dtype)], axis=1)


def _joined(arrays: list[Any]) -> Any:
    """Batches of one as one batch. A single one is not copied."""
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)
