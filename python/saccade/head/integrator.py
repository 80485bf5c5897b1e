"""How a step follows the velocity from noise to actions."""

from __future__ import annotations

from saccade.errors import InputError

#: Velocity evaluations in one step of each integrator.
INTEGRATORS = {"euler": 1, "midpoint": 2}


def check_integrator(integrator: object) -> str:
    """The name of the integrator. None means ``"euler"``.

    Raises:
        InputError: There is no integrator of that name.
    """
    if integrator is None:
        return "euler"
    if not isinstance(integrator, str) or integrator not in INTEGRATORS:
        raise InputError(f"integrator: expected {' or '.join(INTEGRATORS)}, got {integrator!r}")
    return integrator
