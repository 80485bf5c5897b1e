"""End-to-end policy: camera images, state and instruction in; actions in the robot's units out."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from saccade._internal.arrays import Array, ArrayLike, integer
from saccade.errors import InputError
from saccade.head.chunking import Chunking
from saccade.head.context import Context
from saccade.head.intervention import Intervention
from saccade.head.options import check_guidance
from saccade.observations import Requirements
from saccade.policy.encoding import PolicyContext, encode_observations, encode_with_and_without
from saccade.policy.example import example_observation
from saccade.policy.guidance import Without, check_without
from saccade.policy.interfaces import Head, VisionLanguageBackbone
from saccade.policy.loading import check_fit, check_name, embodiment_of, load_parts, read_normalizer
from saccade.policy.reading import Observations, is_observation, read_observations, read_states
from saccade.policy.sampling import Sampling, sample_from, start_of_batch, start_of_state
from saccade.policy.units import restore_units
from saccade.processor import Preprocessing, Processor
from saccade.robots import DataConfigLike, Normalizer


class Policy:
    """End-to-end policy: an action head, the robot's statistics, and the backbone if it has one.

    :meth:`from_pretrained` loads a whole checkpoint: camera frames and an instruction in, the robot's actions
    out. ``Policy(head)`` makes a policy without a backbone, which is called with backbone features.

    No call changes the result of another, and any number of threads may call a policy at the same time. It
    keeps recent instructions, which are tokenized once, and no images, states or actions. The actions for an
    observation have the same bits alone and in any batch.

    Args:
        head: The action head.
        normalizer: The normalizer of the robot, or anything that :meth:`saccade.Normalizer.from_pretrained`
            reads one from. Default: the checkpoint that the head was loaded from.
        embodiment: Tag or id of the robot. Required if the statistics are of several robots. If the
            statistics do not contain the id, an id given here selects the head's embodiment.
        data_config: As for :meth:`saccade.Normalizer.from_pretrained`, which reads the normalizer.
        backbone: The backbone, or None.
        processor: The processor of the backbone's inputs, or None.
        requirements: What the checkpoint says about observations, as
            :func:`saccade.observations.read_requirements` returns it. Embodiment and state are those of the
            normalizer.

    Attributes:
        head: The action head.
        backbone: The backbone, or None.
        processor: The processor, or None.
        normalizer: The normalizer.
        embodiment_id: The embodiment of the head that is used, a number.
        requirements: What an observation must contain; ``str`` of it is a sentence.

    Raises:
        FileNotFoundError, CheckpointError: As :meth:`saccade.Normalizer.from_pretrained`.
        InputError: The normalizer does not fit the head, or the embodiment is not known.

    Example:
        The head of the bundled demo policy, on the features of one observation. The state is the position of
        the hand (x, y, z) and the opening of the gripper:

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
        backbone: VisionLanguageBackbone | None = None,
        processor: Processor | None = None,
        requirements: Requirements | None = None,
    ) -> None:
        source = head.source if normalizer is None else normalizer
        if source is None:
            raise InputError(
                "normalizer: expected a Normalizer, got None for a head that was not loaded from a checkpoint"
            )
        self.head = head
        self.normalizer = read_normalizer(source, embodiment, data_config, head.config)
        if isinstance(embodiment, str) and self.normalizer is normalizer:
            check_name(embodiment, head, self.normalizer)
        check_fit(head, self.normalizer)
        self.embodiment_id = embodiment_of(head, self.normalizer, embodiment)
        self.backbone = backbone
        self.processor = processor
        self.requirements = replace(
            requirements or Requirements(),
            embodiment=self.normalizer.embodiment,
            state=tuple((group.key, group.size) for group in self.normalizer.state_groups),
            state_history=head.config.num_states,
        )

    @classmethod
    def from_pretrained(
        cls,
        id_or_path: str | os.PathLike[str],
        *,
        revision: str | None = None,
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
            id_or_path: The directory or id of a checkpoint, as for
                :meth:`saccade.ActionHead.from_pretrained`.
            revision: A branch, tag or commit of the id. Default: ``main``.
            embodiment: Tag or id of the robot. Required if the checkpoint has statistics of several robots.
            preprocessing: ``"lerobot"`` or ``"isaac"``: how frames and instruction are prepared. It must be
                the way of the program that trained the checkpoint. Default: by version and layout; see
                ``repr`` of ``policy.processor``.
            tokenizer: A ``tokenizer.json``, or a directory with one or with ``vocab.json`` and
                ``merges.txt``. Default: the checkpoint's own, else the published one of its release.
            precision: How backbone and head compute, as for :meth:`saccade.ActionHead.from_pretrained`: one
                name for both, or ``{"backbone": name, "head": name}``.
            num_threads: Number of threads, as for :meth:`saccade.ActionHead.from_pretrained`.
            normalizer: A normalizer, or anything that :meth:`saccade.Normalizer.from_pretrained` reads one
                from. Default: the checkpoint.
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
            FileNotFoundError: ``id_or_path``, a file of the checkpoint or the tokenizer does not exist.
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
            id_or_path,
            revision=revision,
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
        return cls(**parts)

    def act(
        self,
        observation: Observations,
        *,
        previous: PolicyContext | None = None,
        noise: ArrayLike | None = None,
        seed: Any = None,
        num_steps: int | None = None,
        integrator: str | None = None,
        num_samples: int | None = None,
        future_refresh: int | None = None,
        intervention: Intervention | Sequence[Intervention] | None = None,
        previous_chunk: Any = None,
        chunking: Chunking | None = None,
        guidance: float | None = None,
        without: Without | None = None,
    ) -> Any:
        """Predicts a chunk of actions. Equivalent to :meth:`encode` followed by :meth:`sample`.

        Call these two instead to keep the context: for several samples of one observation, or as ``previous``
        of the next.

        Args:
            observation, previous: As in :meth:`encode`.
            noise, seed, num_steps, integrator, num_samples, future_refresh: As in :meth:`sample`.
            intervention, previous_chunk, chunking, guidance: As in :meth:`sample`.
            without: As in :meth:`encode`. Default: ``"default"`` if ``guidance`` needs it.

        Returns:
            As :meth:`sample` with an observation.

        Raises:
            InputError, ShapeError, DtypeError: As :meth:`encode` and :meth:`sample`; or ``without`` is given
                and ``guidance`` is not.
        """
        processor, backbone = self._require_backbone()
        options = Sampling(
            noise=noise,
            seed=seed,
            num_steps=num_steps,
            integrator=integrator,
            num_samples=num_samples,
            future_refresh=future_refresh,
            intervention=intervention,
            previous_chunk=previous_chunk,
            chunking=chunking,
            guidance=check_guidance(guidance),
        )
        if without is not None:
            check_without(without)
            if guidance is None:
                raise InputError(f"without: expected guidance with it, got {without!r} alone")
        batch = read_observations(observation, self.requirements)
        start = start_of_batch(batch, options, self.head, self.normalizer)
        parts = (processor, backbone, self.head, previous)
        if options.guidance is None:
            encoded = encode_observations(batch, *parts)
        else:
            encoded = encode_with_and_without(batch.parsed, without or "default", *parts)
        actions = sample_from(start, encoded, self.head, self.embodiment_id)
        return restore_units(actions, batch, self.normalizer)

    def encode(
        self,
        observation: Observations,
        *,
        previous: PolicyContext | None = None,
        without: Without | None = None,
    ) -> PolicyContext:
        """Encodes camera frames and instruction.

        Args:
            observation: In one of three formats, detected by its keys. Without the batch axis B, the actions
                have none either.

                - Isaac-GR00T, nested: ``{"video": {name: (B, T, H, W, 3)}, "state": {key: (B, T, D)},
                  "language": {key: [[text]]}}``, frames uint8.
                - Isaac-GR00T, flat: ``video.<name>``, ``state.<key>``, and ``annotation.<...>`` with a string
                  or a list of one string for each row.
                - lerobot: ``observation.images.<name> (B, 3, H, W)``, uint8 or float from 0 to 1,
                  ``observation.state (B, D)``, and ``task``, a string for each row or one for all.

                Or a sequence of observations, which need not agree in format, size or length. They are
                computed together, and each has the bits that it has alone.
            previous: The context of earlier observations of this policy. Vision tokens of views with the same
                frames, and the unchanged beginning of a prompt, are taken from it. The result has the same
                bits without.
            without: Also encodes the observations without their instructions, for ``guidance`` in
                :meth:`sample`: with ``"default"``, what the release has for a missing instruction, which
                Isaac-GR00T N1.6 and N1.7 do not have; or with ``"empty"``, an empty one. Vision tokens and
                the common beginning of the prompt are computed once.

        Raises:
            InputError, ShapeError, DtypeError: The observation does not fit the robot; the message lists what
                the robot needs. Or this policy has no backbone, or ``previous`` does not fit. With
                ``without``: an observation has no instruction, or the release has no such default.
            MemoryError: There is not enough memory.
        """
        processor, backbone = self._require_backbone()
        batch = read_observations(observation, self.requirements)
        parts = (processor, backbone, self.head, previous)
        if without is None:
            return encode_observations(batch, *parts)
        return encode_with_and_without(batch.parsed, without, *parts)

    def sample(
        self,
        context: PolicyContext | Context,
        observation_or_state: Observations | ArrayLike,
        *,
        noise: ArrayLike | None = None,
        seed: Any = None,
        num_steps: int | None = None,
        integrator: str | None = None,
        num_samples: int | None = None,
        future_refresh: int | None = None,
        intervention: Intervention | Sequence[Intervention] | None = None,
        previous_chunk: Any = None,
        chunking: Chunking | None = None,
        guidance: float | None = None,
    ) -> Any:
        """Samples chunks of the robot's actions.

        Args:
            context: From :meth:`encode`, or from ``encode`` of the head.
            observation_or_state: An observation as in :meth:`encode`, of which only the state is read. Or the
                state as an array, ``(batch, state_width)`` or ``(batch, state_history, state_width)``, in the
                robot's units.
            noise: The noise that sampling starts from, as in :meth:`saccade.ActionHead.sample`. For an
                observation without a batch axis, it may have none either.
            seed, num_steps, integrator, num_samples, future_refresh, intervention: As in
                :meth:`saccade.ActionHead.sample`.
            previous_chunk: The chunk that the robot is executing, as this method returned it, in the robot's
                units. Actions relative to the state are converted to the new state. The padding beyond the
                robot's action is zero, as in training.
            chunking: How the chunk continues the previous one. Its ``horizon`` is the normalizer's
                ``action_horizon`` by default.
            guidance: A weight w of at least 0. Sampling follows ``v(without the words) + w (v(with them) -
                v(without them))``, where v is the velocity of the flow; see
                :meth:`saccade.ActionHead.sample`. None and 1 are without guidance. Other weights need a
                context from ``encode`` with ``without``.

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
        options = Sampling(
            noise=noise,
            seed=seed,
            num_steps=num_steps,
            integrator=integrator,
            num_samples=num_samples,
            future_refresh=future_refresh,
            intervention=intervention,
            previous_chunk=previous_chunk,
            chunking=chunking,
            guidance=check_guidance(guidance),
        )
        if not is_observation(observation_or_state):
            return self._sample_state(context, observation_or_state, options)  # type: ignore[arg-type]
        batch = read_states(observation_or_state, self.requirements)  # type: ignore[arg-type]
        start = start_of_batch(batch, options, self.head, self.normalizer)
        actions = sample_from(start, context, self.head, self.embodiment_id)
        return restore_units(actions, batch, self.normalizer)

    def __call__(
        self,
        backbone_features: ArrayLike,
        state: ArrayLike,
        *,
        attention_mask: ArrayLike | None = None,
        image_mask: ArrayLike | None = None,
        drop_vl: ArrayLike | None = None,
        noise: ArrayLike | None = None,
        seed: Any = None,
        num_steps: int | None = None,
        integrator: str | None = None,
        num_samples: int | None = None,
        future_refresh: int | None = None,
        intervention: Intervention | Sequence[Intervention] | None = None,
        previous_chunk: ArrayLike | None = None,
        chunking: Chunking | None = None,
    ) -> Array:
        """Predicts a chunk from features of a backbone of your own: ``head.encode``, then :meth:`sample`.

        Args:
            backbone_features, attention_mask, image_mask, drop_vl: As in :meth:`saccade.ActionHead.encode`.
            state, noise, seed, num_steps, integrator, num_samples, future_refresh: As in :meth:`sample`.
            intervention, previous_chunk, chunking: As in :meth:`sample`.

        Returns:
            As :meth:`sample` with a state.

        Raises:
            ShapeError, DtypeError, InputError: As :meth:`saccade.ActionHead.encode` and :meth:`sample`.
        """
        options = Sampling(
            noise=noise,
            seed=seed,
            num_steps=num_steps,
            integrator=integrator,
            num_samples=num_samples,
            future_refresh=future_refresh,
            intervention=intervention,
            previous_chunk=previous_chunk,
            chunking=chunking,
        )
        context = self.head.encode(
            backbone_features, attention_mask=attention_mask, image_mask=image_mask, drop_vl=drop_vl
        )
        return self._sample_state(context, state, options)

    @property
    def nbytes(self) -> int:
        """Size of the weights of head and backbone in memory, in bytes."""
        return self.head.nbytes + (0 if self.backbone is None else self.backbone.nbytes)

    def example_observation(self, seed: int = 0) -> dict[str, Any]:
        """An observation that this policy accepts, to try it.

        Args:
            seed: Seed of the frames, at least 0.

        Returns:
            In Isaac-GR00T's nested format, with a batch of one: random frames, a state in the middle of the
            range of the statistics, and an instruction. Only dicts, lists, strings and arrays.

        Raises:
            InputError: ``seed`` is no integer of at least 0.
        """
        return example_observation(self.requirements, self.normalizer, integer("seed", seed, least=0))

    def _sample_state(self, context: PolicyContext | Context, state: ArrayLike, options: Sampling) -> Array:
        start = start_of_state(state, options, self.head, self.normalizer)
        actions = sample_from(start, context, self.head, self.embodiment_id)
        return self.normalizer.actions(actions, state)

    def _require_backbone(self) -> tuple[Processor, VisionLanguageBackbone]:
        """Processor and backbone of a whole policy."""
        if self.processor is None or self.backbone is None:
            raise InputError(
                "act and encode: this policy has no backbone, since it was made from an action head: call it "
                "with backbone features, policy(features, state), or load a whole checkpoint with "
                "saccade.Policy.from_pretrained(checkpoint)"
            )
        return self.processor, self.backbone

    def __repr__(self) -> str:
        parts = f" backbone={self.backbone!r} processor={self.processor!r}"
        return (
            f"<saccade.Policy embodiment_id={self.embodiment_id} head={self.head!r} "
            f"normalizer={self.normalizer!r}{'' if self.backbone is None else parts}>"
        )
