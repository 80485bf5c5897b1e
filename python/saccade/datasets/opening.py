"""Opens a data set: a local folder, or a repository on the Hugging Face Hub."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from saccade._internal.extras import SACCADE
from saccade._internal.small_files import read_json
from saccade.datasets.dataset import Dataset
from saccade.datasets.metadata import read_metadata
from saccade.datasets.modality import plain, read_modality
from saccade.datasets.selection import SelectionLike, read_selection
from saccade.datasets.source import folder_of
from saccade.datasets.stored import Stored
from saccade.errors import DatasetError


def open(
    path_or_id: str | os.PathLike[str],
    *,
    revision: str | None = None,
    data_config: SelectionLike | None = None,
    modality: Mapping[str, Any] | str | os.PathLike[str] | None = None,
) -> Dataset:
    """Opens a LeRobotDataset of version 2.0, 2.1 or 3.0. Needs the extra ``data``.

    Args:
        path_or_id: A folder, or the id of a data set on the Hugging Face Hub, such as ``lerobot/pusht``. An
            existing path takes precedence. A data set of the Hub is downloaded as a whole.
        revision: A branch, tag or commit of the id. Default: ``main``.
        data_config: Which keys and steps an observation and a chunk have: a data config of N1.5, as for
            :meth:`saccade.Normalizer.from_pretrained`; or modality configs of N1.6 and N1.7,
            ``{"video": {"delta_indices": [0], "modality_keys": ["front"]}, ...}``. Default: all keys of the
            data set, at the present step.
        modality: Contents or path of a ``modality.json`` in place of the data set's own. Without either,
            the keys are ``state``, ``action``, the cameras by name, and ``task``.

    Raises:
        FileNotFoundError: The folder, the id or a file of the data set does not exist.
        DatasetError: The metadata are damaged, or ``modality.json`` points to something that is not there.
        InputError: The data set has not the keys of the data config.
        MissingExtraError: A package of the extra ``data`` is not installed.

    Example:
        >>> import saccade
        >>> def first_chunk(checkpoint: str, recordings: str) -> dict:
        ...     policy = saccade.Policy.from_pretrained(checkpoint)
        ...     data = saccade.datasets.open(recordings)
        ...     return policy.act(data.observation(0, 0), seed=0)
    """
    SACCADE.require("pyarrow", "av")
    root = folder_of(path_or_id, revision)
    metadata = read_metadata(root)
    where = root / "meta" / "modality.json"
    given = modality
    if given is None and os.path.lexists(where):  # a link to nothing is damaged, not absent
        given = where
    if given is None:
        keys = plain(metadata.features, str(root / "meta" / "info.json"))
    elif isinstance(given, Mapping):
        keys = read_modality(given, metadata.features, "modality")
    else:
        keys = read_modality(read_json(Path(given), DatasetError), metadata.features, str(given))
    return Dataset(Stored(metadata), keys, read_selection(data_config, keys))
