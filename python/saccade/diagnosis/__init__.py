"""Diagnosis: which inputs a policy uses, from recordings; ``docs/diagnose.md`` has the rules.

- ``changes``: the changes of each input; ``plan``: steps, partners and instructions.
- ``effects``: what they do to the actions; ``verdicts``: what follows; ``report``: all of it.
"""

from saccade.diagnosis.diagnosing import diagnose
from saccade.diagnosis.report import Diagnosis
from saccade.diagnosis.verdicts import Effect, Verdict

__all__ = ["Diagnosis", "Effect", "Verdict", "diagnose"]
