"""What `show_config` says of this CPU, and what `SACCADE_ISA` may name."""

from __future__ import annotations

import re

import pytest

import saccade
from saccade import _saccade
from saccade.errors import InputError


def test_show_config_says_what_decides() -> None:
    config = saccade.show_config("dicts")
    family, rates, tiles = _saccade.cpu_report()
    assert (config["family"], config["rates"], config["tiles"]) == (family, rates, tiles)
    assert config["cpu"]
    assert re.search(r"measured", rates)
    assert tiles == "yes" or tiles.startswith("no: ")


def test_tiles_are_used_where_they_may_be(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SACCADE_ISA", raising=False)
    config = saccade.show_config("dicts")
    assert ("amx" in config["available_isas"]) == (config["tiles"] == "yes")
    if config["tiles"] == "yes":
        assert config["isa"] == "amx"
    else:
        assert config["isa"] == config["available_isas"][-1] != "amx"


@pytest.mark.skipif("amx" in _saccade.available_isas(), reason="this process may use AMX")
def test_amx_is_refused_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SACCADE_ISA", "amx")
    reason = saccade_tiles().removeprefix("no: ")
    with pytest.raises(InputError, match=r"SACCADE_ISA: expected one of portable.*, got `amx`") as refused:
        _saccade.selected_isa()
    said = str(refused.value)
    assert said.endswith(", which this CPU lacks" if reason == "this CPU lacks AMX" else f": {reason}")
    assert "software_tiles" not in said


def saccade_tiles() -> str:
    return _saccade.cpu_report()[2]


def test_the_emulation_is_never_chosen_or_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "software_tiles" not in _saccade.available_isas()
    monkeypatch.setenv("SACCADE_ISA", "software_tiles")
    assert _saccade.selected_isa() == "software_tiles"
    assert saccade.show_config("dicts")["isa"] == "software_tiles"
