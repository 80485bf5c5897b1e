"""Sentences about an inspected checkpoint: what is unusual, and evidence for and against a random start."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from saccade.checkpoints.description import Description
from saccade.checkpoints.findings import Embodiment, Part, PartResemblance, Resemblance, TokenStatistics
from saccade.checkpoints.initialisation import NORMAL_STD
from saccade.robots import N15_IDS

#: Embodiments that NVIDIA's published N1.5 checkpoint was trained with.
PRETRAINED = ("gr1", "agibot_genie1", "oxe_droid")

#: Number of groups of equal tokens that are listed individually.
SHOWN = 4

#: Cosines between a checkpoint's tensors and those it was trained from are far above, cosines of unrelated
#: tensors far below.
RELATED = 0.5

#: Number of future tokens of the published checkpoints.
PUBLISHED_TOKENS = 32

#: What it means whether the future tokens are distributed as before training: the side, and the words.
VERDICTS = {
    True: ("for", "distributed as"),
    False: ("against", "not distributed as"),
    None: ("neither", "too few to compare with"),
}

#: Parts whose distribution is evidence.
JUDGED = ("DiT blocks", "VL self-attention", "timestep encoder", "output projections")


def odd_tokens(tokens: TokenStatistics | None, description: Description) -> list[str]:
    """What is unusual about the future tokens."""
    if tokens is None:
        # Tokens that are not finite are reported as such.
        has_none = description.version == "n1.5" and description.config.num_future_tokens == 0
        return ["this N1.5 head has no future tokens"] if has_none else []
    groups = [", ".join(map(str, group)) for group in tokens.identical]
    odd = [f"future tokens {group} are identical" for group in groups[:SHOWN]]
    if len(groups) > SHOWN:
        odd.append(f"the future tokens of {len(groups) - SHOWN} more groups are identical")
    odd += [f"future token {index} is zero" for index in tokens.zero]
    if tokens.key_bias is not None:
        odd.append("the keys of the future tokens have a bias that only saccade applies")
    return odd


def odd_embodiments(embodiments: Sequence[Embodiment]) -> list[str]:
    """What is unusual about the layers of the embodiments."""
    ids = [str(entry.id) for entry in embodiments if entry.weights == "zero"]
    if not ids:
        return []
    return [f"the layers of {len(ids)} embodiments are zero, as after saccade convert: {', '.join(ids)}"]


def from_noise(
    version: str,
    parts: Mapping[str, Part],
    tokens: TokenStatistics | None,
    embodiments: Sequence[Embodiment],
    reference: Resemblance | None,
) -> dict[str, list[str]]:
    """Sentences for and against "this checkpoint was trained from a random start", and neutral ones."""
    found: dict[str, list[str]] = {"for": [], "against": [], "neither": []}
    for name in JUDGED:
        part = parts.get(name)
        if part is None or not part.judged:
            continue
        share = part.as_drawn / part.judged
        side = "for" if share > 0.5 else "against" if share < 0.05 else "neither"
        found[side].append(
            f"{name}: {part.as_drawn} of {part.judged} tensors are distributed as before any training"
        )
    if tokens is not None:
        side, verdict = VERDICTS[tokens.as_drawn]
        found[side].append(
            f"future tokens: {verdict} N(0, {NORMAL_STD}), distance {tokens.distance:.3f}, "
            f"standard deviation {tokens.std:.4f}"
        )
        if tokens.count != PUBLISHED_TOKENS:
            found["neither"].append(
                f"{tokens.count} future tokens, whereas published checkpoints have {PUBLISHED_TOKENS}: a "
                "loader that refuses different shapes drops this checkpoint, or a published one for a model "
                f"with {tokens.count}"
            )
    if version == "n1.5" and len(embodiments) == 32:
        for name in PRETRAINED:
            entry = embodiments[N15_IDS[name]]
            if entry.weights == "zero":
                continue
            side = "for" if entry.weights == "as initialised" else "against"
            found[side].append(
                f"embodiment {entry.id} ({name}), which NVIDIA trained: its layers look {entry.weights}"
            )
    if reference is not None:
        for name, resemblance in reference.parts.items():
            side, what = _likeness(resemblance)
            found[side].append(f"{name} compared with the reference: {what}")
        found["neither"] += [
            f"a shape differs from the reference: {shape}" for shape in reference.different_shapes
        ]
    return found


def _likeness(part: PartResemblance) -> tuple[str, str]:
    """The side that a part's resemblance to the reference is on, and the reason."""
    same = f"{part.identical} of {part.compared} tensors and slices are identical"
    if part.cosine is None:
        return ("against" if part.identical else "neither"), same
    others = f"cosines of the other weights are {part.cosine.min:.3f} to {part.cosine.max:.3f}"
    if part.cosine.mean > RELATED or part.identical * 2 > part.compared:
        return "against", f"{same}, {others}"
    return ("for" if part.cosine.max < RELATED else "neither"), f"{same}, {others}"
