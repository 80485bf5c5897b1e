"""How the velocity is followed from noise to actions in one step."""

from __future__ import annotations

from saccade.errors import InputError

#: Evaluations of the velocity in one step of each.
INTEGRATORS = {"euler": 1, "midpoint": 2}


def check_integrator(integrator: object) -> str:
    """The integrator's name; None stands for Euler's.

    Raises:
        InputError: there is none of that name.
    """
    if integrator is None:
        return "euler"
    if not isinstance(integrator, str) or integrator not in INTEGRATORS:
        raise InputError(f"integrator: expected {' or '.join(INTEGRATORS)}, got {integrator!r}")
    return integrator
