"""Independent work items in several processes, of this machine or of a Ray cluster.

`saccade rollout`, `demos` and `study` share it. `workers` says where items run, and `items` runs them;
`local` and `cluster` are the two kinds of processes; `files` brings checkpoints to other machines.
"""

from saccade_lab.parallel.each import each
from saccade_lab.parallel.workers import ALONE, Lost, Workers

__all__ = ["ALONE", "Lost", "Workers", "each"]
