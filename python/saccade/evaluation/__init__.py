"""Open-loop evaluation: predicted actions compared with recorded ones; ``docs/evaluate.md`` has the rules.

- ``recordings``: what is needed of a data set; ``prediction``: the chunks of one episode.
- ``measures``: errors and baselines; ``report``: all of them; ``open_loop``: the function.
- ``certificate``: a record that another machine can check.
- ``source``, ``work``, ``episode_files``: what the commands need to go on where a run stopped.
- ``pairing``: what two runs must share to be compared chunk by chunk.
"""

from saccade._internal.bootstrap import Estimate
from saccade.evaluation.measures import Errors
from saccade.evaluation.open_loop import evaluate
from saccade.evaluation.prediction import Predicted
from saccade.evaluation.recordings import Recordings
from saccade.evaluation.report import Comparison, Evaluation

__all__ = ["Comparison", "Errors", "Estimate", "Evaluation", "Predicted", "Recordings", "evaluate"]
