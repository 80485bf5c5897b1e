"""A whole GR00T checkpoint as one of lerobot's policies: tensors in, actions out, computed by saccade."""

import warnings
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_IMAGES
from torch import Tensor
from typing_extensions import Self

import saccade
from lerobot_policy_saccade.configuration_saccade import NO_TRAINING, SaccadeConfig
from lerobot_policy_saccade.files import (
    CHECKPOINT,
    DATA_CONFIG,
    DATA_CONFIG_FILE,
    TOKENIZER,
    copy_checkpoint,
    folder_of,
)
from lerobot_policy_saccade.lerobot_config import saved_options
from lerobot_policy_saccade.libero import as_in_lerobot, is_libero
from lerobot_policy_saccade.processor_saccade import make_saccade_pre_post_processors
from lerobot_policy_saccade.real_time_chunking import continued
from saccade.policy.loading import returned_horizon
from saccade.robots.data_configs import RELEASED
from saccade.robots.libero import EXECUTED_STEPS

OBSERVATION, TASK = "observation.", "task"

#: What the processors of lerobot's own GR00T policy add to a batch. Its actions would be converted twice.
PACKED = "embodiment_id"

#: Seeds are drawn below this number.
SEEDS = 2**63 - 1


class SaccadePolicy(PreTrainedPolicy):
    """A :class:`saccade.Policy` in lerobot's form.

    It takes lerobot's observations as they are, without normalisation: the checkpoint has its own statistics,
    and knows how frames and words are prepared. Actions are in the robot's units. It has no torch parameters.

    Args:
        config: The options.
        dataset_stats, dataset_meta: Unused; lerobot passes them.

    Attributes:
        policy: The :class:`saccade.Policy`.

    Raises:
        ValueError: No checkpoint is given, an option is out of range, or the environment's actions have
            another width.
        FileNotFoundError, saccade.CheckpointError: As :meth:`saccade.Policy.from_pretrained`.

    Example:
        >>> import torch
        >>> def first_action(checkpoint: str, frames: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        ...     policy = SaccadePolicy(SaccadeConfig(checkpoint=checkpoint, embodiment="new_embodiment"))
        ...     policy.reset()
        ...     batch = {"observation.images.front": frames, "observation.state": state, "task": ["lift"]}
        ...     return policy.select_action(batch)
    """

    config_class = SaccadeConfig
    name = "saccade"

    def __init__(self, config: SaccadeConfig, *, dataset_stats: Any = None, dataset_meta: Any = None) -> None:
        super().__init__(config)
        if config.checkpoint is None:
            raise saccade.InputError("checkpoint: expected a path or an id, got none (--policy.checkpoint)")
        self._checkpoint, self._tokenizer = config.checkpoint, config.tokenizer
        self._data_config = config.data_config
        policy = saccade.Policy.from_pretrained(
            config.checkpoint,
            embodiment=_embodiment(config.embodiment),
            preprocessing=config.preprocessing,  # type: ignore[arg-type]  # it is checked there
            tokenizer=config.tokenizer,
            precision={"backbone": config.precision, "head": config.head_precision or config.precision},
            num_threads=config.num_threads,
            cameras=config.cameras,
            data_config=config.data_config,
            action_horizon=config.action_horizon,
            processor_options=config.processor_options,
        )
        self.policy = as_in_lerobot(policy)
        normalizer = self.policy.normalizer
        _check_renames(self.policy.requirements.rename_map)
        width = config.action_feature.shape[-1] if config.action_feature else normalizer.action_width
        if width != normalizer.action_width:
            keys = ", ".join(f"{group.key} ({group.size})" for group in normalizer.action_groups)
            raise saccade.InputError(
                f"{ACTION}: expected an environment of {normalizer.action_width} numbers, {keys}, got {width}"
            )
        saved = saved_options(config.checkpoint)
        self._chunking = saved.chunking
        horizon = returned_horizon(self.policy.head, normalizer)
        self._trained = min(horizon, normalizer.trained_horizon or horizon)
        usual = EXECUTED_STEPS if is_libero(policy) else None
        self._steps = _steps(config.n_action_steps, saved.n_action_steps or usual, horizon, self._trained)
        features = saved.image_features or _image_features(self.policy)
        config.checkpoint_image_features = features  # type: ignore[misc]  # a field would be saved
        self._actions: deque[Tensor] = deque()
        self._chunks = 0

    def reset(self) -> None:
        """Forgets what is left of the last chunk. lerobot calls it before every episode."""
        self._actions.clear()
        self._chunks = 0

    def select_action(self, batch: Mapping[str, Any], noise: Tensor | None = None) -> Tensor:
        """The next action: of the last chunk, or of a new one when that is used up.

        Args:
            batch, noise: As in :meth:`predict_action_chunk`.

        Returns:
            float32 ``(B, D)``, in the robot's units.

        Raises:
            saccade.InputError, saccade.ShapeError, saccade.DtypeError: As :meth:`predict_action_chunk`.
        """
        if not self._actions:
            chunk = self.predict_action_chunk(batch, noise=noise)
            self._actions.extend(chunk[:, : self._steps].unbind(1))
        return self._actions.popleft()

    def supports_rtc(self) -> bool:
        """True: :meth:`predict_action_chunk` can continue the last chunk."""
        return True

    def predict_action_chunk(
        self,
        batch: Mapping[str, Any],
        noise: Tensor | None = None,
        *,
        inference_delay: int | None = None,
        prev_chunk_left_over: Tensor | None = None,
        **ignored: Any,
    ) -> Tensor:
        """A chunk of actions for each observation.

        Args:
            batch: ``observation.images.<name>`` ``(B, 3, H, W)``, uint8 or float from 0 to 1;
                ``observation.state`` ``(B, D)``; ``task``, a string for each row. Other keys are ignored.
            noise: float32 ``(B, T, D)`` of the head. Default: drawn; see ``seed`` of the options.
            inference_delay: Number of actions that the robot executes while the new chunk is computed.
            prev_chunk_left_over: Actions of the last chunk that are not executed yet, ``(T, D)`` or ``(B, T,
                D)`` in the robot's units: real-time chunking. The first ones, at most
                ``config.rtc_config.execution_horizon``, become the first of the new chunk:
                ``inference_delay`` of them unchanged, the others less and less so. Those relative to the
                state are converted to the new state. Rows of zeros at the end are padding.
            **ignored: Other keywords of lerobot's policies, which its GR00T policy ignores too.

        Returns:
            float32 ``(B, T, D)``, in the robot's units: the actions that were trained.

        Raises:
            saccade.InputError, saccade.ShapeError, saccade.DtypeError: The observation does not fit the
                robot; the message lists what the robot needs. Or another argument does not fit.
        """
        observation = self._observation(batch)
        context = self.policy.encode(observation)
        rtc = self.config.rtc_config
        options: dict[str, Any] = continued(
            prev_chunk_left_over,
            inference_delay,
            batch=context.batch,
            horizon=self.policy.head.config.action_horizon,
            execution_horizon=None if rtc is None else rtc.execution_horizon,
            chunking=self._chunking,
        )
        if noise is not None:
            options["noise"] = noise
        elif self.config.seed is not None:
            options["seed"] = self.config.seed + self._chunks
        else:
            options["seed"] = int(torch.randint(SEEDS, ()))
        chunk: Tensor = self.policy.sample(context, observation, num_steps=self.config.num_steps, **options)
        self._chunks += 1
        return chunk[:, : self._trained]

    def _observation(self, batch: Mapping[str, Any]) -> dict[str, Any]:
        """What saccade reads of a batch, on the CPU, with the checkpoint's keys.

        Raises:
            saccade.InputError: The batch went through the processors of lerobot's own GR00T policy.
        """
        if PACKED in batch:
            raise saccade.InputError(
                f"batch: expected observations as they are, got {PACKED}, as lerobot's own GR00T processors "
                "make it: load the processors from a folder that save_pretrained of this policy wrote"
            )
        renamed = self.config.rename_map
        names = [renamed.get(key, key) for key in batch if key.startswith(OBSERVATION)]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise saccade.InputError(
                f"rename_map: expected one key for each name, got two for {', '.join(twice)}"
            )
        return {
            renamed.get(key, key): value.cpu() if isinstance(value, Tensor) else value
            for key, value in batch.items()
            if key == TASK or key.startswith(OBSERVATION)
        }

    def forward(self, batch: Mapping[str, Any]) -> NoReturn:
        """Raises a NotImplementedError: there is no training loss."""
        raise NotImplementedError(NO_TRAINING)

    def get_optim_params(self) -> NoReturn:
        """Raises a NotImplementedError: there are no parameters to train."""
        raise NotImplementedError(NO_TRAINING)

    def _save_pretrained(self, save_directory: Path, state_dict: Any = None) -> None:
        """Writes what ``--policy.path`` needs on any machine.

        These are options, processors, a copy of the checkpoint, the tokenizer if the checkpoint has none, and
        the data config if it is a file.
        """
        name = self._data_config if self._data_config in RELEASED else None
        data_config = None if name is not None or self._data_config is None else Path(self._data_config)
        copy_checkpoint(self._checkpoint, self._tokenizer, data_config, save_directory)
        saved = replace(self.config, checkpoint=None, tokenizer=None, data_config=name)
        saved._save_pretrained(save_directory)
        for processor in make_saccade_pre_post_processors(self.config):
            processor.save_pretrained(save_directory)

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        config: SaccadeConfig | None = None,
        force_download: bool = False,
        token: str | bool | None = None,
        cache_dir: str | Path | None = None,
        local_files_only: bool = False,
        revision: str | None = None,
        strict: bool = False,
        dataset_stats: Any = None,
        dataset_meta: Any = None,
        **options: Any,
    ) -> Self:
        """Loads a directory or a published repository.

        Args:
            pretrained_name_or_path: What ``save_pretrained`` wrote, or any whole GR00T checkpoint.
            config: The options. Default: those that were saved, or the defaults.
            force_download, token, cache_dir, local_files_only, revision: As in
                ``huggingface_hub.snapshot_download``. Unused for a directory.
            strict: Unused: tensors that are missing are always an error.
            dataset_stats, dataset_meta: Unused; lerobot passes them.
            **options: Options that replace those of ``config``, such as ``embodiment`` and ``precision``.

        Raises:
            FileNotFoundError: There is neither the directory nor the repository or revision.
            huggingface_hub.errors.HfHubHTTPError: The Hub refuses, or fails in another way.
            ValueError, saccade.CheckpointError: As the class.

        Example:
            >>> def load(**hub: bool | str) -> SaccadePolicy:
            ...     name = "nvidia/GR00T-N1.5-3B"
            ...     return SaccadePolicy.from_pretrained(name, embodiment="gr1", precision="int8", **hub)
        """
        folder = folder_of(
            pretrained_name_or_path,
            revision=revision,
            cache_dir=cache_dir,
            force_download=force_download,
            token=token,
            local_files_only=local_files_only,
        )
        saved, tokenizer = folder / CHECKPOINT, folder / TOKENIZER
        data_config = folder / DATA_CONFIG / DATA_CONFIG_FILE
        if config is None:
            config = PreTrainedConfig.from_pretrained(folder) if saved.is_dir() else SaccadeConfig()
        config = replace(config, **options)
        if config.checkpoint is None:
            config.checkpoint = str(saved if saved.is_dir() else folder)
            if saved.is_dir() and tokenizer.is_dir() and config.tokenizer is None:
                config.tokenizer = str(tokenizer)
            if saved.is_dir() and data_config.is_file() and config.data_config is None:
                config.data_config = str(data_config)
        policy = cls(config)
        policy.eval()
        return policy


def _embodiment(given: str | None) -> str | int | None:
    """A tag, or an id if it is a number."""
    return int(given) if given is not None and given.isdecimal() else given


def _check_renames(saved: tuple[tuple[str, str], ...]) -> None:
    """Checks that it does not matter whether keys were renamed as the checkpoint says before they come here.

    lerobot's programs take a rename map of their own, which users give as the checkpoint has it.

    Raises:
        saccade.InputError: A key would be renamed twice.
    """
    twice = [
        f"{old} to {new} to {dict(saved)[new]}" for old, new in saved if dict(saved).get(new, new) != new
    ]
    if twice:
        raise saccade.InputError(
            "rename_map: expected one whose new names it does not rename again, since lerobot's programs may "
            f"have applied it before; the checkpoint's renames {', '.join(twice)} (policy_preprocessor.json)"
        )


def _steps(given: int | None, saved: int | None, horizon: int, trained: int) -> int:
    """How many actions of a chunk are executed.

    Args:
        given: What the user asks for, or None.
        saved: What the checkpoint says, or None.
        horizon: Length of a chunk.
        trained: How many of these were trained.

    Raises:
        saccade.InputError: ``given`` is more than there are.
    """
    if given is not None and given > horizon:
        raise saccade.InputError(
            f"n_action_steps: expected at most {horizon}, the length of a chunk, got {given}"
        )
    if given is not None and given > trained:
        warnings.warn(
            f"n_action_steps: {given} asked for, but only the first {trained} actions of a chunk were "
            f"trained; {trained} are executed",
            stacklevel=3,
        )
    return min(given or saved or horizon, trained)


def _image_features(policy: saccade.Policy) -> dict[str, PolicyFeature]:
    """The cameras of a policy that takes frames of one size only."""
    return {
        f"{OBS_IMAGES}.{camera.name}": PolicyFeature(
            type=FeatureType.VISUAL, shape=(3, camera.height, camera.width)
        )
        for camera in policy.requirements.cameras or ()
        if camera.height is not None and camera.width is not None
    }
