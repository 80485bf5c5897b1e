"""Registers saccade's policy and environments with lerobot, which imports this package by its name.

lerobot finds the policy class and the processors by the names of the modules, and imports them when they are
used.
"""

from lerobot_policy_saccade.configuration_saccade import SaccadeConfig
from lerobot_policy_saccade.environment_saccade import SaccadeEnv

__all__ = ["SaccadeConfig", "SaccadeEnv"]
