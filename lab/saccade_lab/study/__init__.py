"""Studies: what the parts of an action head do, measured on a policy and reported with intervals.

A study (:mod:`saccade_lab.study.study`) works through cells, small units that are stored as soon as they
are done
(:mod:`saccade_lab.study.run`), on observations of a source (:mod:`saccade_lab.study.source`): the
simulator or a
recording. It leaves one tidy table (:mod:`saccade_lab.study.table`), and the report is made from the
tables alone
(:mod:`saccade_lab.study.report`). Each question has one file in :mod:`saccade_lab.study.questions`.
"""
