"""A released client of Isaac-GR00T at work. `groot_clients` starts it, and reads what it got.

    python groot_client.py RELEASE PORT WORK RESULT

WORK is a pickle of observations by name, RESULT one of what the client returned or raised.
"""

from __future__ import annotations

import importlib
import pickle
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def main(release: str, port: int, work: Path, result: Path) -> None:
    """Runs a client."""
    given = pickle.loads(work.read_bytes())
    calls = {"n1": early_calls, "n1.5-early": early_calls, "n1.5": n15_calls}.get(release, later_calls)(
        port, given
    )
    result.write_bytes(pickle.dumps({name: outcome(call) for name, call in calls.items()}))


def outcome(call: Callable[[], Any]) -> Any:
    """What a call returned, or the text of its error."""
    try:
        return call()
    except RuntimeError as error:
        return f"RuntimeError: {error}"


def early_calls(port: int, given: dict[str, Any]) -> dict[str, Callable[[], Any]]:
    """N1 and early N1.5 send pickles."""
    service: Any = importlib.import_module("gr00t.eval.service")
    client = service.ExternalRobotInferenceClient(host="127.0.0.1", port=port)
    return {"get_action": lambda: client.get_action(given["flat"])}


def n15_calls(port: int, given: dict[str, Any]) -> dict[str, Callable[[], Any]]:
    """N1.5's client of robots and of simulations."""
    robot: Any = importlib.import_module("gr00t.eval.robot")
    client = robot.RobotInferenceClient(host="127.0.0.1", port=port)
    return {
        "ping": client.ping,
        "get_action": lambda: client.get_action(given["flat"]),
        "batch": lambda: client.get_action(given["flat batch"]),
        "modality": lambda: plain(client.get_modality_config()),
        "bad": lambda: client.get_action(given["bad"]),
        "kill": client.kill_server,
        "ping again": client.ping,
    }


def later_calls(port: int, given: dict[str, Any]) -> dict[str, Callable[[], Any]]:
    """N1.6's and N1.7's client."""
    server_client: Any = importlib.import_module("gr00t.policy.server_client")
    client = server_client.PolicyClient(host="127.0.0.1", port=port)
    session = server_client.__file__  # another one for each release
    return {
        "ping": client.ping,
        "get_action": lambda: client.get_action(given["nested"]),
        "seeded": lambda: client.get_action(given["nested"], {"seed": 11}),
        "batch": lambda: client.get_action(given["nested batch"], {"seed": 12}),
        "flat": lambda: client.get_action(given["flat batch"], {"seed": 13}),
        "session": lambda: client.get_action(
            given["nested"], {"seed": 14, "session": session, "executed": 0}
        ),
        "continued": lambda: client.get_action(
            given["nested"], {"seed": 15, "session": session, "executed": 3}
        ),
        "reset": client.reset,
        "anew": lambda: client.get_action(given["nested"], {"seed": 16, "session": session, "executed": 3}),
        "modality": lambda: plain(client.get_modality_config()),
        "bad": lambda: client.get_action(given["bad"]),
        "kill": client.kill_server,
        "ping again": client.ping,
    }


def plain(configs: Any) -> Any:
    """`ModalityConfig`s as dicts; that they could be made is checked by making them."""
    return {
        name: {"delta_indices": config.delta_indices, "modality_keys": config.modality_keys}
        for name, config in configs.items()
    }


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3]), Path(sys.argv[4]))
