"""Judges the inner loops of the ARM kernels by llvm-mca, and prints a table in Markdown.

    .ci/aarch64/run.sh loops

Takes the assembly of saccade-vla-kernels. A loop is a block that ends in a jump to its own beginning; of
those with the same instruction, the ones of the largest tile count. What a loop could do at most is what
llvm-mca predicts for its multiply-adds alone, without loads and jumps.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

#: The share of what its multiply-adds alone could do that every loop should reach.
LEAST = 0.9
#: Instruction -> multiply-adds of one.
INSTRUCTIONS = {"fmla": 4, "bfmmla": 16, "bfdot": 8, "sdot": 16, "usmmla": 32}
#: The CPUs, and what each lacks.
CPUS = {
    "cortex-a76": {"bfmmla", "bfdot", "usmmla"},
    "neoverse-n1": {"bfmmla", "bfdot", "usmmla"},
    "neoverse-v1": set[str](),
    "apple-m1": {"bfmmla", "bfdot", "usmmla"},
}
MCA = ("llvm-mca-19", "-mtriple=aarch64", "-mattr=+dotprod,+i8mm,+bf16", "-iterations=100")
JUMP = re.compile(r"(?:b\.\w+|cbn?z|tbn?z)\s+(?:.*,\s*)?(\.L\w+)$")


@dataclass(frozen=True)
class Loop:
    """The instructions of a loop."""

    instructions: tuple[str, ...]

    @property
    def counts(self) -> Counter[str]:
        """How often each mnemonic occurs."""
        return Counter(line.split()[0] for line in self.instructions)

    @property
    def kind(self) -> str:
        """The multiply-add that it has most of."""
        return max(INSTRUCTIONS, key=lambda name: self.counts[name])

    @property
    def in_attention(self) -> bool:
        """Whether it asks for no later weights."""
        return "prfm" not in self.counts

    @property
    def multiply_adds(self) -> tuple[str, ...]:
        """These instructions alone."""
        return tuple(line for line in self.instructions if line.split()[0] == self.kind)


def loops_of(assembly: str) -> list[Loop]:
    """All loops of one block."""
    loops = []
    label, body = "", list[str]()
    for line in assembly.splitlines():
        if started := re.match(r"(\S+):", line):
            label, body = started[1], []
            continue
        instruction = line.split("//")[0].strip()
        if not instruction or instruction.startswith("."):
            continue
        body.append(instruction)
        jump = JUMP.match(instruction)
        if jump and jump[1] == label:
            loops.append(Loop(tuple(body)))
    return loops


def cycles(instructions: tuple[str, ...], cpu: str) -> float:
    """Cycles of an iteration, as llvm-mca predicts them; without the jump, whose label is not there."""
    text = "\n".join(line for line in instructions if not JUMP.match(line))
    said = subprocess.run([*MCA, f"-mcpu={cpu}"], input=text, capture_output=True, text=True, check=True)
    total = re.search(r"Total Cycles:\s+(\d+)", said.stdout)
    if total is None:
        raise ValueError(f"llvm-mca: expected total cycles, got {said.stdout[:200]!r}")
    return int(total[1]) / 100


def largest(loops: list[Loop]) -> list[Loop]:
    """For each instruction, in products with weights and in attention, the loop with most multiply-adds."""
    best = dict[tuple[str, bool], Loop]()
    for loop in loops:
        place = (loop.kind, loop.in_attention)
        loads = sum(loop.counts[name] for name in ("ldr", "ldp"))
        if loads < 2 or len(loop.multiply_adds) < 20 or loop.counts["and"] > 0:
            continue
        # Of equal tiles the one that asks for one line a step: that of more rows than a few.
        order = (-len(loop.multiply_adds), len(loop.instructions))
        if place not in best or order < (-len(best[place].multiply_adds), len(best[place].instructions)):
            best[place] = loop
    return [best[place] for place in sorted(best)]


def main() -> int:
    """Prints the table. The exit status is 1 if an instruction has no loop, or a loop less than `LEAST`."""
    columns = ["instruction", "of", "multiply-adds", "instructions", "instructions a multiply-add", *CPUS]
    print(f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
    loops = largest(loops_of(Path(sys.argv[1]).read_text()))
    wrong = [f"no loop of {kind}" for kind in INSTRUCTIONS if kind not in {loop.kind for loop in loops}]
    for loop in loops:
        count = len(loop.multiply_adds) * INSTRUCTIONS[loop.kind]
        row = [f"`{loop.kind}`", "attention" if loop.in_attention else "weights", str(count)]
        row += [str(len(loop.instructions)), f"{len(loop.instructions) / count:.3f}"]
        for cpu, lacks in CPUS.items():
            share = cycles(loop.multiply_adds, cpu) / cycles(loop.instructions, cpu)
            row.append("" if loop.kind in lacks else f"{100 * share:.0f} %")
            if loop.kind not in lacks and share < LEAST:
                wrong.append(f"{loop.kind} on {cpu}: {share:.2f} of it, expected at least {LEAST}")
        print(f"| {' | '.join(row)} |")
    for what in wrong:
        print(f"aarch64: {what}", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
