"""A policy in the robot's units: what the robot sees and is told in, the robot's actions out."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from saccade._internal.arrays import Array, ArrayLike, float32, integer
from saccade.backbone.backbone import Backbone
from saccade.backbone.features import BackboneFeatures
from saccade.backbone.inputs import BackboneInputs
from saccade.errors import InputError, ShapeError
from saccade.head.context import Context
from saccade.head.options import PolicyOptions, SampleOptions
from saccade.observations import ObservationSources, Reading, Requirements, StateReading, read, read_state
from saccade.policy.batching import Observation, Observations, batched, is_observation, listed
from saccade.policy.context import PolicyContext, encoded
from saccade.policy.example import example_observation
from saccade.policy.head import Head, check_steps, continue_chunk, embodiment_of
from saccade.policy.loading import load as load_parts
from saccade.processor import Preprocessing, Processor
from saccade.robots import DataConfigLike, Normalizer
from saccade.robots.embodiments import resolved

if TYPE_CHECKING:
    from typing_extensions import Unpack

Kind = TypeVar("Kind", bound=StateReading)


class Policy:
    """A policy in the robot's units: an action head with a normalizer, and the backbone that sees and reads.

    :meth:`load` loads a whole checkpoint: camera frames and an instruction in, the robot's actions out.
    ``Policy(head)`` makes a policy without a backbone: backbone features in.

    A policy is immutable, and holds nothing of the observations that it was given: any number of threads may
    call it at the same time. The answer to an observation has the same bits alone and in any batch.

    Args:
        head: The action head.
        normalizer: The normalizer of the robot, or anything that
        :meth:`saccade.Normalizer.from_pretrained` reads one
            from. Default: the checkpoint that the head was loaded from.
        embodiment: Tag or id of the robot. Required if the statistics are of several robots. If the
            statistics do not contain the id, an id given here selects the head's embodiment.
        data_config: As for :meth:`saccade.Normalizer.from_pretrained`, which reads the normalizer.
        backbone: The backbone, or None.
        processor: The processor of the backbone's inputs, or None.
        sources: What the checkpoint says about observations.

    Attributes:
        head: The action head.
        backbone: The backbone, or None.
        processor: The processor, or None.
        normalizer: The normalizer.
        embodiment_id: The embodiment of the head that is used.
        requirements: What an observation must contain; ``str`` of it is a sentence.

    Raises:
        FileNotFoundError, CheckpointError: As :meth:`saccade.Normalizer.from_pretrained`.
        InputError: The normalizer does not fit the head, or the embodiment is not known.

    Example:
        The head of the bundled demo policy, on the features of one observation. The state is the position of
        the hand (x, y, z) and the opening of the gripper:

        >>> import importlib.resources
        >>> import numpy as np, saccade
        >>> head = saccade.ActionHead.from_pretrained(saccade.demo_checkpoint())
        >>> policy = saccade.Policy(head)
        >>> features = np.zeros((1, 57, head.config.context_dim), np.float32)
        >>> policy(features, np.array([[0.0, 0.6, 0.2, 1.0]]), seed=0).shape
        (1, 16, 4)
    """

    def __init__(
        self,
        head: Head,
        normalizer: Normalizer | Mapping[str, Any] | str | os.PathLike[str] | None = None,
        embodiment: str | int | None = None,
        *,
        data_config: DataConfigLike | None = None,
        backbone: Backbone | None = None,
        processor: Processor | None = None,
        sources: ObservationSources | None = None,
    ) -> None:
        config = head.config
        if not isinstance(normalizer, Normalizer):
            source = head.source if normalizer is None else normalizer
            if source is None:
                raise InputError(
                    "normalizer: expected a Normalizer, got None for a head that was not loaded from a "
                    "checkpoint"
                )
            normalizer = Normalizer.from_pretrained(
                source,
                embodiment,
                data_config=data_config,
                state_dim=config.state_dim,
                action_dim=config.encoder_action_dim,
            )
        elif data_config is not None:
            raise InputError("data_config: expected None with a Normalizer, which has its own")
        elif isinstance(embodiment, str) and not _is_named(embodiment, config.version, normalizer.embodiment):
            raise InputError(
                f"embodiment: expected that of the normalizer, {normalizer.embodiment!r}, got {embodiment!r}"
            )
        if normalizer.state_dim != config.state_dim or normalizer.action_width > config.action_dim:
            raise InputError(
                f"normalizer: expected states of width {config.state_dim} and actions of at most width "
                f"{config.action_dim}, as this head has them, got states of width {normalizer.state_dim} "
                f"and actions of width {normalizer.action_width}"
            )
        check_steps(head, normalizer)
        self.head = head
        self.normalizer = normalizer
        self.embodiment_id = embodiment_of(head, normalizer, embodiment)
        self.backbone = backbone
        self.processor = processor
        known = ObservationSources() if sources is None else sources
        self.requirements = Requirements(
            embodiment=normalizer.embodiment,
            state=tuple((group.key, group.size) for group in normalizer.state_groups),
            state_history=config.num_states,
            **vars(known),
        )

    @classmethod
    def from_pretrained(
        cls,
        source: str | os.PathLike[str],
        *,
        embodiment: str | int | None = None,
        preprocessing: Preprocessing | None = None,
        tokenizer: str | os.PathLike[str] | None = None,
        precision: str | Mapping[str, str] = "float32",
        num_threads: int | None = None,
        normalizer: Normalizer | Mapping[str, Any] | str | os.PathLike[str] | None = None,
        cameras: Sequence[str] | None = None,
        data_config: DataConfigLike | None = None,
        action_horizon: int | None = None,
        processor_options: Mapping[str, Any] | None = None,
    ) -> Policy:
        """Loads a whole checkpoint: backbone, action head, tokenizer, processor and statistics.

        Of the head, only the layers of the chosen embodiment are loaded.

        Args:
            source: The directory or id of a checkpoint, as for :meth:`saccade.ActionHead.from_pretrained`.
            embodiment: Tag or id of the robot. Required if the checkpoint has statistics of several robots.
            preprocessing: ``"lerobot"`` or ``"isaac"``: how frames and words are prepared. It must be the way
                of the program that trained the checkpoint. Default: by version and layout; see ``repr`` of
                ``policy.processor``.
            tokenizer: A ``tokenizer.json``, or a directory with one or with ``vocab.json`` and
                ``merges.txt``. Default: in the checkpoint, else in the local cache of ``huggingface_hub``.
            precision: How backbone and head compute, as for :meth:`saccade.ActionHead.from_pretrained`:
            one name for
                both, or ``{"backbone": name, "head": name}``.
            num_threads: Number of threads, as for :meth:`saccade.ActionHead.from_pretrained`.
            normalizer: A normalizer, or anything that :meth:`saccade.Normalizer.from_pretrained` reads one
            from.
                Default: the checkpoint.
            cameras: The names of the cameras in the order of the prompt. Default: those of the data config or
                the checkpoint.
            data_config: GR00T N1 and N1.5: the data config that the checkpoint was trained with, as for
                :meth:`saccade.Normalizer.from_pretrained`. The head denoises as many actions as it has
                ``action_indices``, and takes as many states as it has ``observation_indices``.
            action_horizon: Number of actions that the head denoises, for a fine-tune that was trained with
                another number than its config says.
            processor_options: Options of the checkpoint's processor to replace, such as
                ``{"letter_box_transform": True}``; see :meth:`saccade.Processor.from_pretrained`.

        Raises:
            FileNotFoundError: ``source``, a file of the checkpoint or the tokenizer does not exist.
            CheckpointError: The checkpoint is damaged, or holds only a head or only a backbone. The message
                says which part is missing.
            InputError: An option is out of range.

        Example:
            >>> import saccade
            >>> def first_chunk(checkpoint: str) -> dict:
            ...     policy = saccade.Policy.from_pretrained(checkpoint, precision="int8")
            ...     return policy.act(policy.example_observation(), seed=0)
        """
        parts = load_parts(
            source,
            embodiment=embodiment,
            preprocessing=preprocessing,
            tokenizer=tokenizer,
            precision=precision,
            num_threads=num_threads,
            normalizer=normalizer,
            cameras=cameras,
            data_config=data_config,
            action_horizon=action_horizon,
            processor_options=processor_options,
        )
        return cls(
            parts.head,
            parts.normalizer,
            parts.embodiment,
            backbone=parts.backbone,
            processor=parts.processor,
            sources=parts.sources,
        )

    def act(
        self,
        observation: Observations,
        *,
        previous: PolicyContext | None = None,
        **options: Unpack[PolicyOptions],
    ) -> Any:
        """Looks, reads and acts: :meth:`encode` followed by :meth:`sample`.

        Call these two instead to keep the context: for several samples of one observation, or as ``previous``
        of the next.

        Args:
            observation, previous: As in :meth:`encode`.
            **options: As in :meth:`sample`.

        Returns:
            As :meth:`sample` with an observation.

        Raises:
            InputError, ShapeError, DtypeError: As :meth:`encode` and :meth:`sample`.
        """
        readings = self._read(observation)
        context = self._encoded(readings, previous)
        return self._sampled(context.context, observation, readings, options)

    def encode(self, observation: Observations, *, previous: PolicyContext | None = None) -> PolicyContext:
        """Encodes what the robot sees and is told.

        Args:
            observation: In one of three forms, told by its keys. Without the batch axis B, so is the answer.

                - Isaac-GR00T, nested: ``{"video": {name: (B, T, H, W, 3)}, "state": {key: (B, T, D)},
                  "language": {key: [[text]]}}``, frames uint8.
                - Isaac-GR00T, flat: ``video.<name>``, ``state.<key>``, and ``annotation.<...>`` with a string
                  or a list of one string for each row.
                - lerobot: ``observation.images.<name> (B, 3, H, W)``, uint8 or float from 0 to 1,
                  ``observation.state (B, D)``, and ``task``, a string for each row or one for all.

                Or a sequence of observations, which need not agree in form, size or length. They are computed
                together, and each has the bits that it has alone.
            previous: The context of earlier observations of this policy. Vision tokens of views with the same
                frames, and the unchanged beginning of a prompt, are taken from it. The result has the same
                bits without.

        Raises:
            InputError, ShapeError, DtypeError: The observation does not fit the robot; the message lists what
                the robot needs. Or this policy has no backbone, or ``previous`` does not fit.
            MemoryError: There is not enough memory.
        """
        return self._encoded(self._read(observation), previous)

    def inputs(self, observation: Observations) -> list[BackboneInputs]:
        """The backbone's inputs for each observation: resized frames and token ids, a batch of one each.

        Args:
            observation: As in :meth:`encode`.

        Raises:
            InputError, ShapeError, DtypeError: As :meth:`encode`.
        """
        return self._inputs(self._read(observation))

    def features(
        self, inputs: Sequence[BackboneInputs], *, previous: PolicyContext | None = None
    ) -> tuple[BackboneFeatures, ...]:
        """The backbone's features for each of its inputs.

        Args:
            inputs: As :meth:`inputs` returns them.
            previous: As in :meth:`encode`.

        Raises:
            InputError: This policy has no backbone, or ``previous`` does not fit.
        """
        backbone = self._whole("features", self.backbone)
        if previous is not None and not isinstance(previous, PolicyContext):
            raise InputError(f"previous: expected what encode returns, got {type(previous).__name__}")
        return tuple(backbone._ragged(inputs, previous=() if previous is None else previous.features))

    def context(self, features: Sequence[BackboneFeatures]) -> PolicyContext:
        """What the head encodes of features of any lengths.

        Args:
            features: As :meth:`features` returns them.
        """
        return encoded(self.head, features)

    def __call__(
        self,
        backbone_features: ArrayLike,
        state: ArrayLike,
        *,
        attention_mask: ArrayLike | None = None,
        image_mask: ArrayLike | None = None,
        drop_vl: ArrayLike | None = None,
        **options: Unpack[SampleOptions],
    ) -> Array:
        """:meth:`saccade.ActionHead.encode` followed by :meth:`sample`.

        Args:
            backbone_features, attention_mask, image_mask, drop_vl: As in ``encode`` of the head.
            state: As in :meth:`sample`.
            **options: Keyword arguments of :meth:`sample`.
        """
        context = self.head.encode(
            backbone_features, attention_mask=attention_mask, image_mask=image_mask, drop_vl=drop_vl
        )
        return self._of_state(context, state, options)

    def sample(
        self,
        context: PolicyContext | Context,
        observation_or_state: Observations | ArrayLike,
        **options: Unpack[PolicyOptions],
    ) -> Any:
        """Samples chunks of the robot's actions.

        Args:
            context: From :meth:`encode`, or from ``encode`` of the head.
            observation_or_state: An observation as in :meth:`encode`, of which only the state is read. Or the
                state as an array, ``(batch, state_width)`` or ``(batch, state_history, state_width)``, in the
                robot's units.
            **options: Keyword arguments of :meth:`saccade.ActionHead.sample` except ``out``, with these
                differences:

                - ``previous_chunk``: the chunk that the robot is executing, as this method returned it, in
                  the robot's units. Actions relative to the state are converted to the new state. The padding
                  beyond the robot's action is zero, as in training.
                - ``chunking``: its ``horizon`` is the normalizer's ``action_horizon`` by default.
                - ``noise``: for an observation without a batch axis, it may have none either.

        Returns:
            float32 in the robot's units. The horizon T is the normalizer's ``action_horizon``, if it has one,
            else that of the head. With ``num_samples``, there is an axis of them before T.

            - For a state: ``(batch, T, action_width)``. A torch tensor if the head's features were torch.
            - For an observation of Isaac-GR00T, nested: ``{name: (B, T, D)}``; flat: ``{"action.<name>": (B,
              T, D)}``. For one of lerobot: ``(B, T, action_width)``, a torch tensor if it contains one.
            - For a sequence of observations: a list of these.

        Raises:
            ShapeError, DtypeError, InputError: As :meth:`saccade.ActionHead.sample` and
                :class:`saccade.Normalizer`; or the observation does not fit the robot.
        """
        held = context.context if isinstance(context, PolicyContext) else context
        if not is_observation(observation_or_state):
            return self._of_state(held, observation_or_state, options)  # type: ignore[arg-type]
        observations = listed(observation_or_state)  # type: ignore[arg-type]
        readings = [self._read_by(read_state, one) for one in observations]
        return self._sampled(held, observation_or_state, readings, options)  # type: ignore[arg-type]

    def example_observation(self, seed: int = 0) -> dict[str, Any]:
        """An observation that this policy accepts, to try it.

        Args:
            seed: Seed of the frames, at least 0.

        Returns:
            In Isaac-GR00T's nested form, with a batch of one: random frames, a state in the middle of the
            range of the statistics, and an instruction. Only dicts, lists, strings and arrays.
        """
        return example_observation(self.requirements, self.normalizer, integer("seed", seed, least=0))

    def _read(self, observation: Observations) -> list[Reading]:
        self._whole("act and encode", self.backbone)
        return [self._read_by(read, one) for one in listed(observation)]

    def _read_by(
        self, reader: Callable[[Observation, Requirements], Kind], observation: Observation | Reading
    ) -> Kind | Reading:
        """An observation read by a reader, or what was already read of it.

        Raises:
            InputError: It was read for another policy. Or as the reader.
        """
        if not isinstance(observation, Reading):
            return reader(observation, self.requirements)
        if observation.needs != self.requirements:
            raise InputError(
                f"observation: expected what was read for this policy, got what was read for "
                f"another: {observation.needs}, but {self.requirements}"
            )
        return observation

    def _inputs(self, readings: Sequence[Reading]) -> list[BackboneInputs]:
        processor = self._whole("inputs", self.processor)
        found = []
        for reading in readings:
            for frames, instruction in zip(reading.frames, reading.instructions, strict=True):
                # Without their names, by which lerobot's processor would sort them: they are in order.
                inputs = processor(list(frames.values()), instruction, plain_text=reading.is_plain)
                inputs.view_names = tuple(frames)
                found.append(inputs)
        return found

    def _encoded(self, readings: Sequence[Reading], previous: PolicyContext | None) -> PolicyContext:
        return self.context(self.features(self._inputs(readings), previous=previous))

    def _sampled(
        self,
        context: Context,
        observation: Observations,
        readings: Sequence[StateReading],
        options: PolicyOptions,
    ) -> Any:
        """The answers to observations, in their form."""
        state = np.concatenate([reading.state for reading in readings])
        if len(state) != context.batch:
            raise InputError(
                f"observation: expected {context.batch}, as many as in context, got {len(state)}"
            )
        is_single = isinstance(observation, Mapping | Reading)
        options = options.copy()
        previous, noise = options.get("previous_chunk"), options.get("noise")
        if previous is not None:
            keys = tuple(group.key for group in self.normalizer.action_groups)
            chunks = [previous] if is_single else list(previous)
            if len(chunks) != len(readings):
                raise InputError(f"previous_chunk: expected {len(readings)}, got {len(chunks)}")
            joined = [
                batched(float32("previous_chunk", reading.dialect.previous_chunk(chunk, keys)), 3, reading)
                for reading, chunk in zip(readings, chunks, strict=True)
            ]
            if len({chunk.shape[1:] for chunk in joined}) != 1:
                listed = ", ".join(str(chunk.shape) for chunk in joined)
                raise ShapeError(f"previous_chunk: expected chunks of one length and width, got {listed}")
            options["previous_chunk"] = np.concatenate(joined)
        if noise is not None and is_single:
            axes = 3 if options.get("num_samples") is None else 4
            options["noise"] = batched(np.asarray(noise), axes, readings[0])
        actions = np.asarray(self._of_state(context, state, options))
        answers, start = [], 0
        for reading in readings:
            chunk = actions[start : start + len(reading)]
            parts = {
                key: np.ascontiguousarray(chunk[..., where])
                for key, where in self.normalizer.action_slices.items()
            }
            answers.append(reading.dialect.answer(parts, reading))
            start += len(reading)
        return answers[0] if is_single else answers

    def _of_state(self, context: Context, state: ArrayLike, options: SampleOptions) -> Array:
        """:meth:`sample` of a state."""
        if "out" in options:
            raise InputError("out: expected none, since it would contain the normalised actions of the head")
        previous = options.get("previous_chunk")
        if previous is not None:
            continue_chunk(self.head, self.normalizer, previous, state, options)
        actions = self.head.sample(context, self.normalizer.state(state), self.embodiment_id, **options)
        return self.normalizer.actions(actions, state)

    def _whole(self, what: str, part: Any) -> Any:
        """A part of a whole policy.

        Raises:
            InputError: It is None.
        """
        if part is None:
            raise InputError(
                f"{what}: this policy has no backbone, since it was made from an action head: call it with "
                "backbone features, policy(features, state), or load a whole checkpoint with "
                "saccade.Policy.from_pretrained(checkpoint)"
            )
        return part

    def __repr__(self) -> str:
        parts = f" backbone={self.backbone!r} processor={self.processor!r}"
        return (
            f"<saccade.Policy embodiment_id={self.embodiment_id} head={self.head!r} "
            f"normalizer={self.normalizer!r}{'' if self.backbone is None else parts}>"
        )


def _is_named(name: str, version: str, embodiment: str | None) -> bool:
    """Whether a name is that of a robot, as its release resolves it."""
    return resolved(name, version, () if embodiment is None else (embodiment,)) == embodiment
