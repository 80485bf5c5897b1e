"""Studies: what the parts of an action head do, measured on a policy and reported with intervals.

A study (:mod:`saccade.study.study`) works through cells, small units that are stored as soon as they are done
(:mod:`saccade.study.run`), on observations of a source (:mod:`saccade.study.source`): the simulator or a
recording. It leaves one tidy table (:mod:`saccade.study.table`), and the report is made from the tables alone
(:mod:`saccade.study.report`). Each question has one file in :mod:`saccade.study.questions`.
"""
