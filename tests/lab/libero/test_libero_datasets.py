"""Demonstrations of LIBERO as a data set, from a recording that was made up without a simulator."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import saccade.datasets
from saccade_lab.libero import demos
from saccade_lab.libero.recording import LiberoRecording
from tests.helpers.libero_cases import SAID, SIZE, demonstration, write_recording


def test_a_data_set_says_where_another_action_was_executed(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "demos", frame_stride=1)
    tasks = [LiberoRecording("libero_object", task, said, 2, SIZE, 1) for task, said in enumerate(SAID)]
    demos.export(folder, tasks, 1, tmp_path / "data")
    data = saccade.datasets.open(tmp_path / "data")
    assert len(data) == len(SAID)
    for task, said in enumerate(SAID):
        one = demonstration(10 * task, frame_stride=1)
        assert data.instruction(task, 0) == said
        # The recorded action is the expert's there, too.
        np.testing.assert_array_equal(data.column(task, "action")[:, :6], one.actions[:, :6])
        assert np.flatnonzero(data.column(task, "disturbed")[:, 0]).tolist() == [9]
