"""Runs the `get_action` of a torch action head in saccade."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import ModuleType, TracebackType
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from saccade.backbone.backbone import Backbone
from saccade.errors import InputError
from saccade.head.chunking import from_released
from saccade.head.config import HeadConfig
from saccade.head.head import ActionHead
from saccade.head.options import LoadOptions, precisions_of_parts
from saccade.integrations import backbones, heads, modules
from saccade.integrations.accelerated_backbone import AcceleratedBackbone
from saccade.integrations.stand_in import Features, Kinds, StandIn, tolerance_of
from saccade.integrations.weights import tensors_of

#: Additional tolerance, relative to the noise, for rounding it at the start and after each of four steps. It
#: matters for an untrained head, which hardly moves the noise.
EXACT_ROUNDING = 1e-5
ROUNDED_ROUNDING = 1e-2

#: The tokens of the check's observation: text, two image tokens, and text that is padding.
CHECK_IMAGE = (False, True, True, False)
CHECK_ATTENDED = (True, True, True, False)


def accelerate(
    policy: object,
    *,
    backbone: bool = False,
    precision: str | Mapping[str, str] = "float32",
    num_threads: int | None = None,
    embodiment_ids: Sequence[int] | None = None,
) -> Accelerated:
    """Makes the action head of a torch policy compute in saccade, on the CPU, and its backbone if asked to.

    The `get_action` of this instance of the head is replaced, and the `forward` of this instance of the
    backbone. Arguments and results stay the same. The noise is drawn from torch's generator as in the
    original, so equal seeds give equal actions up to rounding. Nothing else in the policy changes, and
    :meth:`Accelerated.restore` puts the originals back. As a check, the originals run once, the head on four
    random tokens and the backbone on a random view, and the results must agree.

    Parts are recognised by their structure: the heads of lerobot and Isaac-GR00T, N1.5 to N1.7, and forks
    that :meth:`saccade.ActionHead.from_pretrained` supports, and the backbones of N1.5 and N1.7. The torch
    weights stay in memory. The copies in saccade take ``handle.head.nbytes`` and ``handle.backbone.nbytes``
    more.

    Args:
        policy: `GrootPolicy` of lerobot, the policy or model of Isaac-GR00T, or the head itself.
        backbone: Whether the backbone computes in saccade too.
        precision: As in :meth:`saccade.ActionHead.from_pretrained`: one name for both parts, or with
            `backbone` one for each, as in ``{"backbone": "int8", "head": "bfloat16"}``. ``"float32"`` is
            exact up to rounding for weights of any dtype.
        num_threads: As in :meth:`saccade.ActionHead.from_pretrained`.
        embodiment_ids: The embodiments whose weights are copied. A call with another id is an error. Default:
            all.

    Returns:
        A handle, with which the originals are put back.

    Raises:
        InputError: `policy` does not contain exactly one head (and backbone), or a part is in training mode,
            compiled, quantised, hooked, replaced or accelerated already, or the original gives other results.
        DtypeError: The call is made under the default device ``meta``.
        CheckpointError: The weights are not those of a GR00T policy. The message lists every problem.

    Example:
        >>> import saccade
        >>> def first_action(policy, batch: dict):
        ...     "Of a `GrootPolicy` that lerobot has loaded, computed in bfloat16 by saccade."
        ...     handle = saccade.accelerate(policy.eval(), precision="bfloat16")
        ...     action = policy.select_action(batch)
        ...     handle.restore()
        ...     return action
    """
    precisions = precisions_of_parts(precision)
    module = modules.find(policy, heads.is_wanted, heads.WANTED)
    tower = modules.find(policy, backbones.is_wanted, backbones.WANTED) if backbone else None
    if tower is None and not isinstance(precision, str):
        raise InputError(f"precision: expected one name without backbone=True, got {dict(precision)!r}")
    for part, method in ((module, "get_action"), (tower, "forward")):
        if part is not None and isinstance(vars(part).get(method), StandIn):
            raise InputError(f"policy: its {type(part).__name__} is accelerated already: restore() it first")
    # The larger part first: what loading needs for a while then adds to less.
    whole = None
    if tower is not None:
        autocast = bool(getattr(getattr(policy, "config", None), "use_bf16", False))
        whole = AcceleratedBackbone(tower, precisions["backbone"], num_threads, autocast)
    handle = Accelerated(module, precisions["head"], num_threads, embodiment_ids, whole)
    handle._install()
    return handle


class Accelerated(StandIn[ActionHead]):
    """The replacement of a torch head's `get_action`: what :func:`accelerate` returns.

    Any number of threads may call it. The weights may change: each call compares them, as far as
    :class:`saccade.integrations.weights.Watch` describes, and copies them again after a change, which takes
    as long as loading. A change that the comparison misses (of a few values through ``.data``) requires
    :meth:`refresh`. Copies and pickles of the policy have the original methods.

    As a context manager it restores the originals at the end.
    """

    _method = "get_action"
    _part = "the head"
    _structure: ClassVar[ModuleType] = heads

    def __init__(
        self,
        module: nn.Module,
        precision: str,
        num_threads: int | None,
        embodiment_ids: Sequence[int] | None,
        backbone: AcceleratedBackbone | None,
    ) -> None:
        self._takes_options = heads.takes_options(module)
        self._backbone = backbone
        options = LoadOptions(precision=precision, num_threads=num_threads, embodiment_ids=embodiment_ids)
        super().__init__(module, options)

    @property
    def head(self) -> ActionHead:
        """The head in saccade, with the current weights.

        It shows what the head computes: ``handle.head.trace(handle.head.encode(features), ...)``.

        Raises:
            InputError: As :attr:`module`, and as :func:`accelerate` if the weights have changed.
        """
        return self._current(self.module)

    @property
    def backbone(self) -> Backbone:
        """The backbone in saccade, with the current weights.

        Raises:
            InputError: As :attr:`head`, or the backbone was not accelerated.
        """
        if self._backbone is None:
            raise InputError(
                "the backbone is not accelerated: call accelerate(policy, backbone=True) for that"
            )
        return self._backbone.backbone

    def refresh(self) -> None:
        """Copies all weights again. Needed only after a change that the comparison misses.

        Raises:
            InputError, CheckpointError: As :func:`accelerate`.
        """
        super().refresh()
        if self._backbone is not None:
            self._backbone.refresh()

    def restore(self) -> None:
        """Puts the original methods back and frees the weights in saccade. A second call does nothing.

        Raises:
            InputError: A method has been replaced by something else in the meantime. Nothing is changed then.
        """
        self._check_restorable()
        if self._backbone is not None:
            self._backbone.restore()
        super().restore()

    def __enter__(self) -> Accelerated:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.restore()

    def __call__(
        self, backbone_output: Any, action_input: Any, options: Mapping[str, Any] | None = None
    ) -> Any:
        """The replacement of the head's `get_action`.

        Args:
            backbone_output: `backbone_features (batch, T_vl, context_dim)`. As in the original, they are
                replaced by the output of the VL self-attention. Heads with text and image blocks also need
                `backbone_attention_mask` and `image_mask`, bool `(batch, T_vl)`.
            action_input: `state (batch, num_states, state_dim)` and `embodiment_id (batch,)`. With
                real-time chunking also `action`, the previous chunk.
            options: Options of real-time chunking, for heads that support it.

        Returns:
            An instance of the original's class with `action_pred (batch, action_horizon, action_dim)` in the
            original's dtype and on its device. From N1.6 on also `backbone_features` and `state_features`.

        Raises:
            InputError: The head is in training mode or has hooks, or a gradient is requested. Also as
                :meth:`saccade.ActionHead.encode` and :meth:`saccade.ActionHead.sample`.
        """
        if options is not None and not self._takes_options:
            raise TypeError("get_action of this head takes no options")
        module = self.module
        if problems := list(heads.in_use([("", module), *self._parts])):
            raise InputError(f"{type(module).__name__}.get_action: {'; '.join(problems)}")
        features, state = backbone_output["backbone_features"], action_input["state"]
        if torch.is_grad_enabled() and (features.requires_grad or state.requires_grad):
            raise InputError(
                "backbone_features and state: expected tensors without gradient, because saccade computes "
                "none; call get_action under torch.no_grad(), detach() them, or restore() the original"
            )
        with torch.no_grad():
            head = self._current(module)
            kinds = self._kinds_of(module, head, features, state)
            chunk = self._chunk(action_input, options, kinds.features)
            noise = draw(head.config, features.shape[0], kinds.features, features.device)
            actions, vl_embs = run(module, head, backbone_output, action_input, noise, chunk)
            vl_embs = vl_embs.to(features.device, kinds.features)
            results = {"action_pred": actions.to(features.device, kinds.actions)}
            if head.config.version not in ("n1", "n1.5"):
                rows = state.reshape(state.shape[0], 1, -1)
                results["backbone_features"] = vl_embs
                results["state_features"] = module.state_encoder(rows, action_input["embodiment_id"])  # type: ignore[operator]
            backbone_output["backbone_features"] = vl_embs
            return kinds.result(data=results)

    def __repr__(self) -> str:
        own = super().__repr__()
        return own if self._backbone is None or self.is_restored else f"{own[:-1]} and {self._backbone!r}>"

    def _install(self) -> None:
        if self._backbone is not None:
            self._backbone._install()
        super()._install()

    def _check_restorable(self) -> None:
        super()._check_restorable()
        if self._backbone is not None:
            self._backbone._check_restorable()

    def _convert(self, module: nn.Module) -> ActionHead:
        head = ActionHead.from_tensors(tensors_of(module), config=heads.config_of(module), **self._options)
        parameters = list(module.parameters())
        # With parameters of mixed dtypes, the original works under autocast only.
        mixed = len({parameter.dtype for parameter in parameters}) > 1
        like = parameters[0].detach()
        with torch.no_grad(), torch.autocast(like.device.type, torch.bfloat16, enabled=mixed):
            self._kinds_of(module, head, like, like)
        return head

    def _compare(self, module: nn.Module, engine: ActionHead, autocast: bool, *like: Tensor) -> Kinds:
        features, state = like
        reduced = autocast or features.dtype != torch.float32
        rounded = reduced or self._options["precision"] != "float32"
        return agree(module, engine, check_inputs(module, engine, features, state), rounded)

    def _chunk(
        self, action_input: Any, options: Mapping[str, Any] | None, dtype: torch.dtype
    ) -> dict[str, Any]:
        """The arguments of `sample` for real-time chunking, from those of the original."""
        if "action" not in action_input:
            return {}
        if not self._takes_options:
            if getattr(self.module, "inference_rtc_overlap_steps", None) is not None:
                raise InputError(
                    "action: saccade does not support the real-time chunking of this head; leave action out, "
                    "or restore() the original"
                )
            return {}
        chunking = from_released(options or {})
        if chunking.overlap == 0:
            return {}
        previous = action_input["action"][:, : chunking.horizon].to("cpu", dtype)
        return {"previous_chunk": previous, "chunking": chunking}


def draw(config: HeadConfig, batch: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The noise `(batch, action_horizon, encoder_action_dim)`, drawn as in the original."""
    size = (batch, config.action_horizon, config.encoder_action_dim)
    return torch.randn(size=size, dtype=dtype, device=device)


def run(
    module: nn.Module,
    head: ActionHead,
    backbone_output: Any,
    action_input: Any,
    noise: Tensor,
    chunk: Mapping[str, Any],
) -> tuple[Tensor, Tensor]:
    """Actions and vision-language tokens in float32 on the CPU, from the inputs of the original."""
    masks = {}
    if head.config.mask_mode != "none":
        masks = {
            "attention_mask": backbone_output["backbone_attention_mask"].cpu(),
            "image_mask": backbone_output["image_mask"].cpu(),
        }
    context = head.encode(backbone_output["backbone_features"].cpu(), **masks)
    actions = head.sample(
        context,
        action_input["state"].cpu(),
        action_input["embodiment_id"].cpu(),
        noise=noise.cpu(),
        num_steps=int(module.num_inference_timesteps),  # type: ignore[arg-type]
        **chunk,
    )
    return actions, context.vl_embs  # type: ignore[return-value]


def most_active(module: nn.Module, embodiment_ids: Sequence[int]) -> int:
    """The embodiment whose decoders have the largest weights. It is a trained one, if there is any."""
    decoders = [weight for name, weight in module.named_parameters() if name.endswith("decoder.layer2.W")]
    norm = torch.linalg.vector_norm
    return max(embodiment_ids, key=lambda index: sum(float(norm(one[index].float())) for one in decoders))


def check_inputs(
    module: nn.Module, head: ActionHead, features: Tensor, state: Tensor
) -> tuple[Features, Features]:
    """A random observation of four tokens, with the dtypes and devices of `features` and `state`."""
    config, generator = head.config, torch.Generator().manual_seed(0)
    # On the CPU, whatever the default device is.
    shape = (1, len(CHECK_IMAGE), config.context_dim)
    tokens = torch.randn(shape, generator=generator, device="cpu")
    rows = torch.randn(1, config.num_states, config.state_dim, generator=generator, device="cpu")
    backbone_output = Features(
        backbone_features=tokens.to(features),
        backbone_attention_mask=torch.tensor([CHECK_ATTENDED], device=features.device),
        image_mask=torch.tensor([CHECK_IMAGE], device=features.device),
    )
    ids = torch.tensor([most_active(module, head.embodiment_ids)], device=features.device)
    return backbone_output, Features(state=rows.to(state), embodiment_id=ids)


def agree(module: nn.Module, head: ActionHead, inputs: tuple[Features, Features], rounded: bool) -> Kinds:
    """Compares both on the same inputs and state of torch's generator; `rounded` if one rounds to 8 bits."""
    backbone_output, action_input = inputs
    device = backbone_output.backbone_features.device
    theirs_output = Features(backbone_output)
    name = type(module).__name__
    gpus = [device] if device.type == "cuda" else []
    with torch.random.fork_rng(gpus):
        result = type(module).get_action(module, theirs_output, action_input)  # type: ignore[attr-defined]
        theirs_after = generator_state(device)
    dtype = theirs_output["backbone_features"].dtype
    with torch.random.fork_rng(gpus):
        noise = draw(head.config, 1, dtype, device)
        ours_after = generator_state(device)
    if not torch.equal(theirs_after, ours_after):
        raise InputError(
            f"{name} cannot be accelerated: its get_action draws random numbers besides the noise"
        )
    theirs = result["action_pred"]
    ours, _ = run(module, head, backbone_output, action_input, noise, {})
    expected, start = theirs.float().cpu(), noise.float().cpu()[..., : theirs.shape[-1]]
    share = tolerance_of(head.precision, rounded)
    rounding = ROUNDED_ROUNDING if rounded else EXACT_ROUNDING
    norm = torch.linalg.vector_norm
    allowed = float(share * norm(expected - start) + rounding * norm(start))
    error = float(norm(ours - expected)) if ours.shape == expected.shape else math.inf
    if not error <= allowed:
        raise InputError(
            f"{name} cannot be accelerated: on random inputs its actions differ from those of saccade; "
            f"expected a difference with norm at most {allowed:.1e}, got {error:.1e}"
        )
    return Kinds(dtype, type(result), theirs.dtype)


def generator_state(device: torch.device) -> Tensor:
    """The state of torch's generator for this device."""
    return torch.cuda.get_rng_state(device) if device.type == "cuda" else torch.get_rng_state()
