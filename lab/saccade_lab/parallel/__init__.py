"""Independent work items in several processes, of this machine or of a Ray cluster.

``saccade rollout``, ``demos`` and ``study`` share it, and ``evaluate`` and ``diagnose`` by
:mod:`saccade_lab.recordings`. ``workers`` says where items run, and ``run`` runs them; ``local`` and
``cluster`` are the two kinds of processes; ``files`` brings checkpoints to other machines.
"""

from saccade_lab.parallel.run import check_lost, each
from saccade_lab.parallel.workers import ALONE, Lost, Workers

__all__ = ["ALONE", "Lost", "Workers", "check_lost", "each"]
