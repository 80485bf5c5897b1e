"""The least time of a piece on a machine, from the peaks that were measured in the same runs."""

from __future__ import annotations

from dataclasses import replace

from benches.cost import ELEMENT_BYTES, floors
from benches.peers.cases import Case, exact_macs
from benches.peers.contenders import CONTENDERS
from benches.peers.results import Results
from benches.peers.text import arithmetic, calls, config
from benches.work import Works, encode_work, sample_work
from saccade_lab.timing import Call, Machine


def limits(results: Results, case: Case, name: str) -> tuple[float, float] | None:
    """Seconds of the multiply-adds of the whole head at the peak, and of reading its weights, once for each
    product; None if the peaks were not measured.
    """
    machine = machine_of(results, case, name)
    if machine is None:
        return None
    unlimited = replace(machine, read_bytes_per_second=float("inf"))
    at_once = replace(machine, macs_per_second=dict.fromkeys(machine.macs_per_second, float("inf")))
    works = works_of(case)
    arithmetics, memory = (
        sum(sum(floors(each, arithmetic(name), work).values()) for work in works)
        for each in (unlimited, at_once)
    )
    return arithmetics, memory


def machine_of(results: Results, case: Case, name: str) -> Machine | None:
    """The peaks for a contender; None if one of them was not measured."""
    isa = CONTENDERS[name].environment.get("SACCADE_ISA", results.data["machine"]["isa"])
    rates = {kind: results.peak(case.threads, isa, kind) for kind in ELEMENT_BYTES}
    known = {kind: rate for kind, rate in rates.items() if rate is not None}
    bandwidth = results.bandwidth(case.threads)
    if len(known) < len(rates) or bandwidth is None:
        return None
    return Machine(isa, case.threads, known, bandwidth, family=results.cpu)


def works_of(case: Case) -> tuple[Works, Works]:
    """The work of `encode` and of `sample`, by part."""
    head = config(case)
    sizes = {"batch": case.batch, "num_samples": case.samples, "num_future_tokens": case.num_future_tokens}
    call = Call.of(head, case.num_vl_tokens, case.steps, **sizes)
    return encode_work(head, call), sample_work(head, call)


def floor(results: Results, case: Case, name: str) -> float | None:
    """Seconds of the exact computation of `both`, of one layer; None if the peaks were not measured.

    Of the whole head it is the sum over its parts of the longer of two times: the multiply-adds at the peak
    of the contender's arithmetic, and reading the weights at the memory's bandwidth. Of other pieces it is
    the time of the multiply-adds.
    """
    machine = machine_of(results, case, name)
    if case.piece in ("head", "throughput") and machine is not None:
        return sum(sum(floors(machine, arithmetic(name), work).values()) for work in works_of(case))
    isa = CONTENDERS[name].environment.get("SACCADE_ISA", results.data["machine"]["isa"])
    peak = results.peak(case.threads, isa, arithmetic(name))
    return None if peak is None else exact_macs(config(case), case)["both"] / calls(case) / peak
