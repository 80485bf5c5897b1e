"""The report on `saccade study answer`: its sentences, tables and figures."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from answer_tables import BOUNDS, CORE, FEWER, LINK, MORE, plan_of, provenance_of, rows_of, section_of
from saccade_lab.study.report import write_report
from saccade_lab.study.section import points
from saccade_lab.study.sign_flip import sign_flip
from saccade_lab.study.table import Provenance, write_provenance
from why_32 import plan as plans
from why_32.results import judged
from why_32.section import section
from why_32.study import Answer


@pytest.mark.parametrize(
    ("zero", "four", "many", "found", "said"),
    [
        (
            *(FEWER, FEWER, MORE, ("more", "more", "more")),
            (
                rf"In these policies, 32 future tokens help: success with them minus success without any is "
                rf"65.0 points \({BOUNDS}; p = 0.0234 after Holm's correction; {LINK}\)\.",
                rf"Compared with 4 tokens, 32 help: the difference is 65.0 points \({BOUNDS}; .*; {LINK}\); "
                rf"with log2\(N \+ 1\), success rises over N = 0, 4, 32, with a slope of 13.\d\d points per "
                rf"unit of log2\(N \+ 1\) \({BOUNDS}; .*; {LINK}\)\.",
            ),
        ),
        (
            *(MORE, MORE, FEWER, ("less", "less", "less")),
            (
                r"In these policies, 32 future tokens hurt: success with them .* is -65.0 points .*",
                r"Compared with 4 tokens, 32 hurt: the difference is -65.0 points .*; with log2\(N \+ 1\), "
                r"success falls over N = 0, 4, 32, with a slope of -13.*",
            ),
        ),
        (
            *(FEWER, FEWER, FEWER, ("small", "small", "small")),
            (
                r"In these policies, 32 future tokens make no difference of 10 points or more, "
                r"the margin set beforehand; smaller ones are not excluded: .* "
                r"is 0.0 points "
                r"\(95 % interval 0.0 to 0.0; p = 1.0000 after .*",
                r"Compared with 4 tokens, 32 make no difference of 10 points or more, the margin set "
                r"beforehand; smaller ones are not excluded: .*; the slope over N = 0, 4, 32, which is "
                r"nearly computed from the first difference, is 0.00 points per unit.*",
            ),
        ),
        (
            *(FEWER[:5], FEWER[:5], MORE[:5], ("undecided", "undecided", "undecided")),
            (
                r"Whether 32 future tokens help in these policies is undecided: .* is 66.0 points "
                r"\(no interval; "
                r"p = 0.1875 after .*",
                r"Whether 32 tokens help compared with 4 is undecided: .*\(no interval; .*; "
                r"the slope over N = 0, 4, 32, which is nearly computed from the first difference, is "
                r"13.40 points per .*\(no interval; .*",
            ),
        ),
        (
            *([0.1, 0.9] * 4, [0.5] * 8, [0.8, 0.2] * 4, ("undecided", "undecided", "undecided")),
            (
                r"Whether 32 future tokens help in these policies is undecided: .* is 0.0 points "
                r"\(95 % interval -70.0 to 70.0; .*",
                r"Whether 32 tokens help compared with 4 is undecided: .*",
            ),
        ),
    ],
)
def test_the_first_two_sentences(
    zero: list[float], four: list[float], many: list[float], found: tuple[str, ...], said: tuple[str, ...]
) -> None:
    whole = section_of({"n-0": zero, "n-4": four, "n-32": many})
    tests = next(grid for grid in whole.grids if grid.caption.startswith("Table 1."))
    assert tuple(row[5] for row in tests.rows) == found
    assert len(whole.answer) == 5
    for sentence, expected in zip(whole.answer, said, strict=False):
        assert re.fullmatch(expected, sentence), sentence
    assert [figure.name for figure in whole.figures] == ["success", "losses"]


def test_a_small_effect_that_is_certain_is_called_small() -> None:
    """Rejected, and inside the margin."""
    rates = {"n-0": [0.50] * 10, "n-4": [0.50] * 10, "n-32": [0.54, 0.56] * 5}
    table = rows_of(rates, 50).assign(validation_loss=0.05)
    whole = section(table, provenance_of(50), plan_of(10))
    assert [row[5] for row in whole.grids[0].rows] == ["more"] * 3
    assert whole.answer[0].startswith("In these policies, 32 future tokens help, by less than 10 points: ")
    assert whole.answer[1].startswith("Compared with 4 tokens, 32 help, by less than 10 points: ")
    assert (
        "success rises over N = 0, 4, 32, by less than 10 points in all, with a slope of" in whole.answer[1]
    )


def test_nothing_is_judged_before_the_core_is_complete() -> None:
    """Neither in sentences nor in tables or figures, and not the later stages either."""
    episodes = len(plans.PLAN.seeds)
    known = Provenance("answer", {"tasks": ["a", "b"], "episodes": list(range(episodes))}, 1, 1)
    rates = {name: [0.25] * 12 for name in ("n-0", "n-4", "n-32", "n-4-aligned")}
    table = rows_of(rates, episodes).assign(validation_loss=0.05)
    last = table[(table["policy"] == "n-32-seed-11") & (table["kind"] == "episodes")].index[-1:]
    partly = section(table.drop(last), known, plans.PLAN)
    assert partly.answer == [
        "No result yet: 35 of the 36 policies of the core are trained and have run all "
        "their episodes. By the "
        "plan, nothing is judged before all of them are there."
    ]
    assert not partly.figures
    (stages,) = partly.grids
    assert [list(row) for row in stages.rows[:3:2]] == [["core", "35", "36"], ["alignment", "6", "12"]]
    assert "n-32-seed-11 (149 of 150 episodes)." in partly.summary[-1]
    assert "points (" not in " ".join([*partly.answer, *partly.summary])
    complete = section(table, known, plans.PLAN)
    assert len(complete.answer) == 5
    assert [row[1] for row in complete.grids[0].rows] == ["12"] * 3
    # Policies of other stages do not count.
    assert (
        section(rows_of({"n-4-aligned": [0.5] * 12}, episodes), known, plans.PLAN)
        .answer[0]
        .startswith("No result yet: of the 36 policies of the core none is trained")
    )


def test_the_sentence_on_larger_first_weights() -> None:
    begin = "Exploratory: with larger first weights (*scaled*, where no policy stopped on the plateau), 32 "
    nothing = section_of(CORE).answer[3]
    assert nothing == (
        "Not measured: 32 tokens against none or 4, with larger first weights (*scaled*). "
        "Not tested: 32 tokens against none, with longer training of both."
    )
    link = r"\[table 3\]\(#table-3\), `--stages scaled`"
    for zero, four, many, said in (
        (
            *(FEWER, MORE, MORE),
            rf"tokens against none: more success, 65.0 points \({BOUNDS}; {link}\); 32 against 4: "
            rf"no difference of 10 points or more, 0.0 points \({BOUNDS}; {link}\)\.",
        ),
        (
            *(MORE, [*MORE[:4], *FEWER[4:6]], FEWER),
            rf"tokens against none: less success, -65.0 points \({BOUNDS}; {link}\); 32 against 4: "
            rf"undecided, -41.7 points \({BOUNDS}; 6 training seeds; {link}\)\.",
        ),
    ):
        rates = {"n-0-scaled": zero, "n-4-scaled": four, "n-32-scaled": many}
        found = section_of({**CORE, **rates}).answer[3]
        assert re.fullmatch(re.escape(begin) + said + " Not tested: .*", found), found
    table = rows_of({**CORE, "n-0-scaled": FEWER, "n-32-scaled": MORE}).assign(validation_loss=0.05)
    table.loc[table["policy"] == "n-0-scaled-seed-1", "validation_loss"] = 0.2
    said = section(table, provenance_of(), plan_of(8)).answer[3]
    assert said.startswith("Exploratory: with larger first weights (*scaled*), 32 tokens against none: more")


def test_new_pairs_are_tested_alone() -> None:
    """All six of one sign are needed, and the pooled ones are an estimate whatever their interval is."""
    first, one_sign = [0.1] * 6, [0.1, 0.2, 0.1, 0.2, 0.1, 0.3]
    core = {name: [0.1] * 12 for name in ("n-0", "n-4", "n-32")}
    for new, said, finding, p in (
        (
            [0.5, 0.6, 0.7, 0.8, 0.6, 0.5],
            "decides that 32 tokens help compared with none, 45.0",
            "more",
            1 / 32,
        ),
        ([0.0] * 6, "decides that 32 tokens hurt compared with none, -16.7", "less", 1 / 32),
        (
            [*one_sign[:5], 0.4],
            "leaves it undecided whether 32 tokens help or hurt compared with none, 1.7",
            *("undecided", 1),
        ),
    ):
        whole = section_of({**core, "n-0-long": [*first, *one_sign], "n-32-long": [*[0.3] * 6, *new]})
        text = whole.answer[3]
        assert f"(1628 steps instead of 1000), the test of the 6 new pairs {said} points (" in text
        assert re.search(
            rf"; p = {p:.4f}; training seeds 6 to 11; \[table 4\]\S*, `--stages compute`\)\. All 12 ", text
        )
        assert "Its interval does not know that half of the pairs were run because of the others." in text
        (grid,) = [grid for grid in whole.grids if "p" in grid.columns and grid.heading != "Table 1"]
        rows = [row for row in grid.rows if row[0].startswith("n-32-long minus n-0-long")]
        assert [(row[0].split(", ")[1], row[1], row[3], row[4]) for row in rows] == [
            ("first six", "6", "", "more"),
            ("new six: tested", "6", f"{p:.4f}", finding),
            ("all twelve: estimate", "12", "", "estimate"),
        ]
        differences = np.array(new) - one_sign
        assert sign_flip(np.round(differences, 12)).p_value == p
        assert rows[1][2] == points(sign_flip(np.round(differences, 12)).difference)
        pooled = sign_flip(np.round([*[0.2] * 6, *differences], 12)).difference
        assert rows[2][2] == points(pooled)
        assert f"give an estimate of {100 * pooled.value:.1f} points (95 % interval " in text
    # With one new pair missing there is neither a test nor an estimate.
    rates = {**core, "n-0-long": [*first, *one_sign], "n-32-long": [0.3] * 11}
    whole = section_of(rates)
    assert "Not tested: 32 tokens against none, with longer training of both." in whole.answer[3]
    (grid,) = [grid for grid in whole.grids if "policies without tokens at the cost of 32" in grid.caption]
    assert [row[0].split(", ")[1] for row in grid.rows] == ["first six"]


def test_the_other_comparisons_are_counted_and_listed() -> None:
    nothing = section_of(CORE)
    assert "Other exploratory comparisons" not in nothing.answer[3]
    (absent,) = nothing.comparisons
    assert absent.startswith(
        "Not measured: 32 tokens against a wider head without tokens at the same cost of"
    )
    assert absent.endswith("; 32 tokens with the alignment loss against 32 without; 64 tokens against 32.")
    some = {
        **CORE,
        "n-32-scaled": MORE,
        "n-4-scaled": FEWER,
        "n-32-aligned": MORE,
        "n-0-wide": FEWER,
        "n-0-long": [*MORE[:3], 0.1],
        "n-4-patch-8": MORE,
        "n-32-patch-8": FEWER,
    }
    whole = section_of(some)
    assert whole.answer[3].endswith(
        "Other exploratory comparisons of 32 tokens with fewer or none: 1 in favour of 32, 1 against, 0 "
        "small and "
        "1 undecided ([table 5](#table-5), [table 6](#table-6)); of what another backbone or another depth "
        "of the "
        "VL self-attention changes in 32 against 4: 0 in favour of 32, 1 against, 0 small and 0 undecided "
        '([table 6](#table-6)); each is listed under "Other comparisons".'
    )
    expected = [
        r"32 tokens against a wider head .*: more success, 65.0 points \(B; \[table 5\]\S*, `--stages "
        r"scaled,compute`\)\.",
        r"32 tokens against longer training .*: undecided, 15.0 points \(no interval; 4 training seeds; "
        r".*\)\.",
        r"32 tokens against 4, with patches of 8 pixels: less success, -65.0 points \(B; \[table 6\]\S*, "
        r"`--stages patch-8`\)\.",
        r"32 tokens against 4, with patches of 8 instead of 16 pixels: a change in favour of 4, -130.0 "
        r"points "
        r"\(B; \[table 6\]\S*, `--stages scaled,patch-8`\)\.",
        r"Not counted in the answer: 32 tokens with the alignment loss against 32 without: no difference "
        r"of 10 points "
        r"or more, 0.0 points \(B; \[table 4\]\S*, `--stages scaled,alignment`\)\.",
        r"Not measured: 32 tokens with the alignment loss against none; .*; 64 tokens against 32\.",
    ]
    assert len(whole.comparisons) == len(expected)
    for found, pattern in zip(whole.comparisons, expected, strict=True):
        assert re.fullmatch(pattern.replace("B;", f"{BOUNDS};"), found), found
    other = {**some, "n-0-wide": [1.0] * 8, "n-4-patch-8": FEWER, "n-32-patch-8": MORE}
    said = section_of(other).comparisons
    assert "wider head without tokens at the same cost of a chunk: less success, -20.0 points" in said[0]
    assert "8 instead of 16 pixels: no change of 10 points or more, 0.0 points" in said[3]
    other = {**other, "n-4-scaled": MORE, "n-32-scaled": FEWER}
    assert (
        "8 instead of 16 pixels: a change in favour of 32, 130.0 points" in section_of(other).comparisons[3]
    )


def test_later_stages_have_their_tables() -> None:
    whole = section_of(
        {
            **CORE,
            "n-4-scaled": FEWER,
            "n-32-scaled": MORE,
            "n-4-aligned": MORE,
            "n-0-wide": FEWER,
            "n-4-patch-8": FEWER,
            "n-32-patch-8": FEWER,
        }
    )
    assert [grid.heading for grid in whole.grids] == [f"Table {place}" for place in range(1, 8)]
    assert whole.grids[-1].columns == ("stage", "done", "planned")
    by_name = {row[0]: row for grid in whole.grids[2:] for row in grid.rows}
    assert by_name["n-4-aligned minus n-4-scaled"][3] == "more"
    assert by_name["n-32-patch-8 minus n-4-patch-8"][3] == "small"
    assert by_name["(n-32-patch-8 minus n-4-patch-8) minus (n-32-scaled minus n-4-scaled)"][3] == "less"


def test_what_is_measured_has_its_tables() -> None:
    """Means over training seeds by hand; what no policy has is left empty."""
    rows = rows_of({name: [0.5] * 6 for name in ("n-0", "n-4", "n-32", "n-4-aligned")})
    trained = rows[rows["kind"] == "training"].sample(frac=1, random_state=0)
    trained = trained[trained["num_future_tokens"] > 0]
    seeds, many = trained["training_seed"], trained["num_future_tokens"]
    measured = []
    for tokens, weight in itertools.product(("learned", "random"), ("kept", "lost")):
        numbers: dict[str, Any] = {"effective_tokens": 2.0 + seeds, "largest_share": 0.25, "overlap": 0.5}
        if tokens == "learned":
            numbers |= {"overlap": 0.75 + 0.01 * seeds, "effective_tokens": many / 2 + seeds}
        for size in ("two", "half", "all"):
            has_it = (weight == "lost") | ((size == "two") & (seeds > 0)) | ((size == "half") & (many > 4))
            numbers[f"explained_{size}"] = np.where(has_it, 0.5, np.nan)
            numbers[f"ratio_{size}"] = np.where(has_it, 1.5, np.nan)
        measured.append(trained.assign(kind="specialise", tokens=tokens, weight=weight, **numbers))
    for group, share in {"future": 0.1, "state": 0.2, "action": 1.0, "all rows": 1.0}.items():
        for block in ("all", "0"):
            found = share * (1 + 0.1 * seeds) if block == "all" else 9.0
            measured.append(trained.assign(kind="patching", group=group, block=block, share=found))
    table = pd.concat([rows, *measured]).assign(validation_loss=0.05)
    whole = section(table, provenance_of(), plan_of(6))
    assert [(figure.name, figure.table) for figure in whole.figures] == [
        ("success", ""),
        ("losses", "Table 2"),
        ("overlap", whole.grids[-5].heading),
    ]
    captions = [grid.caption.split(".")[0] for grid in whole.grids]
    assert captions == [f"Table {place}" for place in range(1, len(captions) + 1)]
    maps, removed, sums, patched, progress = whole.grids[-5:]
    assert sums.note == (
        "In the core's policies with 32 tokens, removing half of them with their weight changes the chunk "
        "1.50 "
        "(1.50 to 1.50) times as much as the sum of their single effects, which explains 0.50 (0.50 to "
        "0.50) of "
        "the change; removing all of them 1.50 (1.50 to 1.50) times as much, and the sum explains 0.50 "
        "(0.50 to "
        "0.50). So single effects do not add up to that of all tokens, which is larger than their sum."
    )
    for ratio, said in ((0.5, "which is smaller than their sum."), (1.0, "of all tokens is undecided.")):
        other = section(table.assign(ratio_all=ratio), provenance_of(), plan_of(6))
        assert other.grids[-3].note.endswith(said)
    no_core = table[~((table["kind"] == "specialise") & (table["recipe"] == "n-32"))]
    assert not section(no_core, provenance_of(), plan_of(6)).grids[-3].note
    done = {row[0]: row[1] for row in progress.rows}
    assert (done["specialise"], done["patching"], done["measures"]) == ("18", "18", "0")
    assert [row[0] for row in maps.rows] == ["n-4", "n-32", "n-4-aligned"]
    overlaps = sign_flip([0.75 + 0.01 * seed for seed in range(6)]).difference
    shown = f"{overlaps.value:.3f} ({overlaps.low:.3f} to {overlaps.high:.3f})"
    assert maps.rows[1] == ["n-32", shown, "0.500 (0.500 to 0.500)", maps.rows[1][3]]
    assert maps.rows[1][3].startswith(f"{overlaps.value - 0.5:.3f} (")
    assert [row[:2] for row in removed.rows[:3]] == [["n-4", "kept"], ["n-4", "lost"], ["n-32", "kept"]]
    assert removed.rows[2][2] == "18.5 (16.0 to 21.0)"
    assert removed.rows[2][4:] == ["14.0 (14.0 to 14.0)", "0.250 (0.250 to 0.250)"]
    assert sums.columns[2:4] == ("two: share explained", "two: ratio")
    assert sums.rows[0][2:] == ["0.50 (no interval)", "1.50 (no interval)", "", "", "", ""]
    assert sums.rows[2][4:] == ["0.50 (0.50 to 0.50)", "1.50 (1.50 to 1.50)", "", ""]
    assert "" not in sums.rows[1]
    assert [cell.split()[0] for cell in patched.rows[0]] == ["n-4", "0.12", "0.25", "1.25", "1.25"]
    assert patched.columns == ("recipe", "future", "state", "action", "all rows")
    only = section(table[table["kind"] != "specialise"], provenance_of(), plan_of(6))
    assert only.grids[-2].rows == patched.rows
    assert only.grids[-2].caption.startswith(f"Table {len(only.grids) - 1}. ")


def test_success_by_task_and_by_loss() -> None:
    """Table 1 and 2 for each task alone, and what success has to do with the held-out loss."""
    table = rows_of({"n-0": FEWER, "n-4": FEWER, "n-32": MORE}).assign(validation_loss=0.05)
    everywhere = (table["kind"] == "episodes") & (table["task"] == "b") & (table["recipe"] == "n-32")
    table.loc[everywhere, "success"] = False
    whole = section(table, provenance_of(), plan_of(8))
    tests, policies = whole.grids[:2]
    assert tests.columns[-2:] == policies.columns[2:4] == ("a", "b")
    assert [row[-2].split(" (")[0] for row in tests.rows[:2]] == ["65.0", "65.0"]
    assert [row[-1].split(" (")[0] for row in tests.rows[:2]] == ["-15.0", "-15.0"]
    assert [cell.split(" (")[0] for cell in policies.rows[2][1:4]] == ["40.0", "80.0", "0.0"]
    assert policies.columns[4:6] == ("held-out loss", "above 0.15")
    assert [row[5] for row in policies.rows] == ["0 of 8"] * 3
    assert "plateau" not in whole.answer[0]
    assert "held-out loss" not in whole.answer[4]
    assert [figure.name for figure in whole.figures] == ["success", "losses"]

    found = judged(table, ("a", "b"), range(10))
    rates = {(recipe, seed): rate for recipe, of in found.rates.items() for seed, rate in of.items()}
    trained = table["kind"] == "training"
    worse = [-rates[row["recipe"], row["training_seed"]] for row in table[trained].to_dict("records")]
    table.loc[trained, "validation_loss"] = worse
    assert (
        "Over the policies of the core, success is correlated with the held-out loss (rank correlation "
        "-1.00, -1.00 to -1.00; figure above [table 2](#table-2), `--stages core`), so a difference "
        "between arms may be one of how far their "
        "training came."
    ) in section(table, provenance_of(), plan_of(8)).answer[4]


def test_policies_on_the_plateau_are_counted() -> None:
    table = rows_of(CORE).assign(validation_loss=0.05)
    on_it = {"n-0": range(5), "n-4": [7], "n-32": []}
    for recipe, seeds in on_it.items():
        for seed in seeds:
            table.loc[table["policy"] == f"{recipe}-seed-{seed}", "validation_loss"] = 0.1501
    whole = section(table, provenance_of(), plan_of(8))
    link = "[table 2](#table-2), `--stages core`"
    said = (
        "of the core's 24 policies stopped on a plateau of their training, with a held-out loss above 0.15: "
    )
    assert whole.answer[0].endswith(
        f" 6 {said}5 of 8 with N = 0, 1 of 8 with N = 4, 0 of 8 with N = 32 ({link})."
    )
    assert [row[5] for row in whole.grids[1].rows] == ["5 of 8", "1 of 8", "0 of 8"]
    table.loc[table["training_seed"] < 4, "validation_loss"] = 0.3
    table.loc[table["training_seed"] >= 4, "validation_loss"] = 0.15  # not above
    assert f" Half {said}4 of 8 with N = 0" in section(table, provenance_of(), plan_of(8)).answer[0]


def test_nothing_trained() -> None:
    table = pd.DataFrame([{"kind": "recording", "recording": "tiny"}])
    nothing = "No result yet: of the 36 policies of the core none is trained and has run all its episodes. "
    assert Answer.summarise(table, provenance_of()).answer[0].startswith(nothing)
    pilot = {"stage": "pilot", "recipe": "n-4-pilot", "policy": "n-4-pilot-seed-100", "training_seed": 100}
    table = pd.DataFrame([{"kind": "training", **pilot, "num_future_tokens": 4, "validation_loss": 0.25}])
    whole = Answer.summarise(table, provenance_of())
    assert whole.answer[0].startswith(nothing)
    assert [list(row) for row in whole.grids[-1].rows] == [["n-4-pilot-seed-100", "0.2500", "", ""]]


def test_the_report_begins_with_the_answer(tmp_path: Path) -> None:
    """Every claim is linked to a table that is there, in both forms."""
    plan = plans.PLAN
    episodes = list(plan.seeds)
    rates = {name: [0.25, 0.5] * 6 for name in ("n-0", "n-4", "n-32")}
    rows = rows_of(rates, len(episodes)).assign(validation_loss=0.05)
    rows.to_csv(tmp_path / "answer.csv", index=False)
    known = Provenance("answer", {"tasks": ["a", "b"], "episodes": episodes}, 1, 1)
    write_provenance(known, tmp_path / "answer.json")
    page, markdown = (path.read_text(encoding="utf-8") for path in write_report(tmp_path))
    text = markdown.split("### Methods")[0]
    assert re.search(r"### The answer\n\n1\. In these .*\n2\. .*\n3\. .*\n4\. .*\n5\. .*\n\n!\[", text)
    assert (
        "\nsaccade study answer --out DIR\nsaccade study report DIR\n```\n\n`--stages NAMES` beside" in text
    )
    assert "commit 388bc69 is the last that trains the core's policies to the same weights." in text
    assert text.count("![") == 1  # the other figures are beside their tables
    assert re.search(
        r"#### Table 2\n\n!\[.*\]\(figures/answer-losses.png\)\n\n\*.*\*\n\n\*Table 2\. ", markdown
    )
    assert "### Other comparisons\n\n- Not measured: " in markdown
    linked = re.findall(r"\(#(.*?)\)", markdown)
    assert linked
    assert set(linked) == set(re.findall(r'href="#(.*?)"', page))
    assert set(linked) <= {f"table-{place}" for place in re.findall(r"^#### Table (\d+)$", markdown, re.M)}
    assert set(linked) <= set(re.findall(r'<h4 id="(.*?)"', page))
    assert page.index("In these policies") < page.index("data:image/svg") < page.index("<h3>Methods")
    assert "](README.md)" not in markdown
    (tmp_path / "README.md").write_text("What was decided before.")
    write_report(tmp_path)
    assert "[README.md](README.md)" in (tmp_path / "report.md").read_text(encoding="utf-8")
