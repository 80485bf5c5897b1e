"""The least time of a piece on a machine, from the peaks that were measured in the same runs."""

from __future__ import annotations

from benches.peers.cases import Case, exact_macs
from benches.peers.contenders import CONTENDERS
from benches.peers.results import Results
from benches.peers.text import arithmetic, calls, config
from saccade.bench.cost import PRECISIONS, Machine, floors
from saccade.bench.work import Call, encode_work, sample_work


def floor(results: Results, case: Case, name: str) -> float | None:
    """Seconds of the exact computation of `both`, of one layer; None if the peaks were not measured.

    Of the whole head it is the sum over its parts of the longer of two times: the multiply-adds at the peak
    of the contender's arithmetic, and reading the weights at the memory's bandwidth. Of other pieces it is
    the time of the multiply-adds.
    """
    isa = CONTENDERS[name].environment.get("SACCADE_ISA", results.data["machine"]["isa"])
    rates = {kind: results.peak(case.threads, isa, kind) for kind in PRECISIONS}
    known = {kind: rate for kind, rate in rates.items() if rate is not None}
    bandwidth = results.bandwidth(case.threads)
    if case.piece == "head" and len(known) == len(rates) and bandwidth is not None:
        call = Call.of(
            config(case), case.num_vl_tokens, case.steps, batch=case.batch, num_samples=case.samples
        )
        machine = Machine(isa, case.threads, known, bandwidth)
        works = (encode_work(config(case), call), sample_work(config(case), call))
        return sum(sum(floors(machine, arithmetic(name), work).values()) for work in works)
    peak = known.get(arithmetic(name))
    return None if peak is None else exact_macs(config(case), case)["both"] / calls(case) / peak
