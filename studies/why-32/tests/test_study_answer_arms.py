"""The sentences of the report on `saccade study answer` about what arms change in the trained policies."""

from __future__ import annotations

import re

import pandas as pd
from answer_tables import BOUNDS, CORE, FEWER, LINK, MORE, rows_of, section_of


def under(arm: str, rates: dict[str, list[float]]) -> pd.DataFrame:
    """Episodes of the core's policies under an arm, with these success rates."""
    table = rows_of(rates)
    return table[table["kind"] == "episodes"].assign(arm=arm)


def test_the_sentence_about_the_cut() -> None:
    assert section_of(CORE).answer[2] == (
        "Not measured: what the trained policies do when their rows no longer attend to the future tokens."
    )
    begin = (
        "Exploratory: when state and action rows of the trained policies no longer attend to the future "
        "tokens, those with 32 tokens "
    )
    for four, many, said in (
        (
            *(MORE, FEWER),
            r"succeed less often, a change of -65.0 points \(B; L\); those with 4 tokens "
            r"succeed more often, a "
            r"change of 65.0 points \(B; L\)\.",
        ),
        (
            *(FEWER, []),
            r"are not measured; those with 4 tokens show no change of 10 points or more: 0.0 "
            r"points \(B; L\)\.",
        ),
        (
            *([], [*MORE[:4], *FEWER[4:6]]),
            r"may succeed more or less often \(undecided\), the change is -23.3 points \(B; 6 "
            r"training seeds; "
            r"L\); those with 4 tokens are not measured\.",
        ),
        (
            *([], FEWER[:1]),
            r"may succeed more or less often \(undecided\), the change is -60.0 points \(no "
            r"interval; 1 training "
            r"seed; L\); those with 4 tokens are not measured\.",
        ),
    ):
        whole = section_of(CORE, under("future-unread", {"n-4": four, "n-32": many}))
        link = LINK.replace("1", "4").replace("core", "core,instrument")
        expected = said.replace("B;", f"{BOUNDS};").replace("L", link)
        assert re.fullmatch(re.escape(begin) + expected, whole.answer[2]), whole.answer[2]
        assert whole.grids[3].heading == "Table 4"
        assert whole.grids[3].columns[1] == "future-unread"


def test_the_sentences_about_one_token_and_less_weight() -> None:
    """After those about the cut, each as far as it is measured."""
    of_cut = under("future-unread", {"n-4": FEWER, "n-32": FEWER})
    one, light = under("1 merged", {"n-32": MORE}), under("mass of 4", {"n-32": FEWER})
    link = LINK.replace("1", "4").replace("core", "core,instrument")
    merged = (
        "When one token, the mean of all, takes the place of the 32 with their weight in the softmax, these "
        rf"policies show no change of 10 points or more: 0.0 points \({BOUNDS}; {link}\)\."
    )
    lighter = (
        r"When the 32 together have the weight of 4, they succeed less often, a change of -65.0 points "
        rf"\({BOUNDS}; {link}\)\."
    )
    for arms, said in (([one, light], f"{merged} {lighter}"), ([one], merged), ([light], lighter), ([], "")):
        whole = section_of(CORE, pd.concat([of_cut, *arms]))
        assert re.fullmatch(rf".*; those with 4 tokens .*?\)\.\s*{said}", whole.answer[2]), whole.answer[2]


def test_the_sentence_about_one_token_with_the_alignment_loss() -> None:
    """After that about the core, with the stage of its policies."""
    trained = rows_of({"n-32-aligned-again": FEWER[:6]})
    episodes = trained[trained["kind"] == "episodes"].assign(arm="1 merged")
    assert "alignment loss" not in section_of(CORE, pd.concat([trained, episodes])).answer[2]
    whole = section_of(CORE, pd.concat([under("1 merged", {"n-32": MORE}), trained, episodes]))
    link = LINK.replace("1", "4").replace("core", "aligned-again,instrument")
    assert re.search(
        r"When the same is done to policies with 32 tokens that were trained with the alignment loss, they "
        rf"show no change of 10 points or more: 0.0 points \({BOUNDS}; 6 training seeds; {link}\)\.$",
        whole.answer[2],
    ), whole.answer[2]
