"""The options of a policy: which checkpoint, for which robot, and how it runs."""

from dataclasses import dataclass, field
from typing import Any, ClassVar, NoReturn

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import PolicyFeature

#: What a method of training raises.
NO_TRAINING = (
    "saccade policies are for inference only. Train the checkpoint with lerobot's groot policy or with "
    "Isaac-GR00T, then load it with --policy.type=saccade"
)


@PreTrainedConfig.register_subclass("saccade")
@dataclass
class SaccadeConfig(PreTrainedConfig):
    """The options ``--policy.*`` of ``--policy.type=saccade``.

    Attributes:
        checkpoint: The directory of a whole GR00T checkpoint, or a published id, which is downloaded.
            Required, except for a directory that ``save_pretrained`` wrote.
        embodiment: Tag or id of the robot. Required if the checkpoint has statistics of several robots.
        precision: How the backbone computes, and the head: float32, bfloat16, int8 or
            int4.
        head_precision: How the head computes. Default: as the backbone.
        num_threads: Number of threads. Default: as :meth:`saccade.Policy.from_pretrained`.
        preprocessing: ``lerobot`` or ``isaac``: how frames and words are prepared. Default: as the
            checkpoint's training program did.
        tokenizer: A ``tokenizer.json`` or its directory. Default: as :meth:`saccade.Policy.from_pretrained`.
        cameras: The names of the cameras in the order of the prompt. Default: those of the checkpoint.
        data_config: Name or file of the data config of an N1.5 checkpoint, as for
            :meth:`saccade.Policy.from_pretrained`.
        action_horizon: Number of actions that were trained, where the checkpoint says another one.
        processor_options: Options of :class:`saccade.Processor` that replace those of the checkpoint.
        rename_map: Keys of the environment's observations, and the keys that the checkpoint knows. For
            example ``{"observation.images.image2": "observation.images.wrist"}``.
        n_action_steps: Number of actions of a chunk that are executed. Default: as the checkpoint says, if
            lerobot wrote it; else all. Actions beyond those that were trained are never executed.
        num_steps: Number of denoising steps. Default: that of the checkpoint.
        seed: Seed of the noise: the chunks after a reset have those of ``seed``, ``seed + 1``, and so on.
            Default: seeds are drawn from torch's generator, which ``lerobot-eval --seed`` seeds.
        rtc_config: Options of real-time chunking, or None. ``lerobot-rollout`` sets it; it is not an option
            of its own, and is not saved.
        checkpoint_image_features: The frames that the checkpoint was trained with, as far as it says so. The
            policy sets it; it is not saved.

    Raises:
        ValueError: ``device`` is not the CPU, or ``n_action_steps`` is less than 1.
    """

    device: str | None = "cpu"
    checkpoint: str | None = None
    embodiment: str | None = None
    precision: str = "float32"
    head_precision: str | None = None
    num_threads: int | None = None
    preprocessing: str | None = None
    tokenizer: str | None = None
    cameras: list[str] | None = None
    data_config: str | None = None
    action_horizon: int | None = None
    processor_options: dict[str, Any] | None = None
    rename_map: dict[str, str] = field(default_factory=dict)
    n_action_steps: int | None = None
    num_steps: int | None = None
    seed: int | None = None

    # Not fields, so that neither is saved or parsed.
    rtc_config: ClassVar[Any] = None
    checkpoint_image_features: ClassVar[dict[str, PolicyFeature]] = {}

    def __post_init__(self) -> None:
        if self.device not in (None, "cpu"):
            raise ValueError(f"device: expected 'cpu', got {self.device!r}; saccade computes on the CPU")
        if self.n_action_steps is not None and self.n_action_steps < 1:
            raise ValueError(f"n_action_steps: expected at least 1, got {self.n_action_steps}")
        self.device = "cpu"
        super().__post_init__()

    @property
    def image_features(self) -> dict[str, PolicyFeature]:
        """The cameras, with the size to which lerobot's async inference server resizes their frames."""
        return super().image_features or self.checkpoint_image_features

    @property
    def observation_delta_indices(self) -> None:
        """None: the policy gets the current observation only."""

    @property
    def action_delta_indices(self) -> None:
        """None: needed for training only."""

    @property
    def reward_delta_indices(self) -> None:
        """None: needed for training only."""

    def validate_features(self) -> None:
        """Nothing to do: the checkpoint says what an observation must contain."""

    def get_optimizer_preset(self) -> NoReturn:
        """Raises a NotImplementedError."""
        raise NotImplementedError(NO_TRAINING)

    def get_scheduler_preset(self) -> NoReturn:
        """Raises a NotImplementedError."""
        raise NotImplementedError(NO_TRAINING)
