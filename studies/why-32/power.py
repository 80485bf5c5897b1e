"""Power of the confirmatory tests of this study, as a table in Markdown.

    python studies/why-32/power.py [EPISODES]

The chance that the primary test rejects after Holm's correction, by the number of training seeds, the
standard deviation of the true success rate between them, and the true difference between N = 0 and N = 32
(N = 4 half-way). The deviations of the arms are independent within a training seed, which is the worst case
of the pairing.
"""

import sys

from why_32.power import power

EFFECTS = (0.0, 0.10, 0.15, 0.20)
DEVIATIONS = (0.04, 0.06, 0.08)
SEEDS = (5, 6, 7, 8, 10, 12)


def main() -> None:
    """Prints the table."""
    episodes = int(sys.argv[1]) if len(sys.argv) > 1 else 150
    print("| seeds | deviation | " + " | ".join(f"{100 * effect:.0f} points" for effect in EFFECTS) + " |")
    print("| --- | --- |" + " --- |" * len(EFFECTS))
    for seeds in SEEDS:
        for deviation in DEVIATIONS:
            found = [
                next(
                    iter(
                        power(
                            run_deviation=deviation,
                            correlation=0.0,
                            rate=0.5,
                            episodes=episodes,
                            num_seeds=seeds,
                            effects=(0.0, effect / 2, effect),
                        ).values()
                    )
                )
                for effect in EFFECTS
            ]
            shares = " | ".join(f"{100 * share:.0f} %" for share in found)
            print(f"| {seeds} | {100 * deviation:.0f} points | {shares} |")


if __name__ == "__main__":
    main()
