"""A torch action head whose `get_action` runs in saccade."""

from __future__ import annotations

import copy
import math
import threading
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MethodType, TracebackType
from typing import TYPE_CHECKING, Any

from saccade.chunking import Chunking
from saccade.config import HeadConfig
from saccade.errors import InputError
from saccade.head import ActionHead
from saccade.integrations import heads
from saccade.integrations.weights import Watch, tensors_of

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

#: The largest error of the check at load, as a share of how far the original moves the noise. Exact
#: arithmetic differs by the released code's own tables, 2e-4; the others round to 8 bits. Another
#: architecture differs by about 1.
EXACT_TOLERANCE = 1e-2
ROUNDED_TOLERANCE = 0.3

#: What is allowed besides, as a share of the noise: rounding it, at the start and after each of four steps.
#: It decides for a head that was never trained, which hardly moves the noise.
EXACT_ROUNDING = 1e-5
ROUNDED_ROUNDING = 1e-2

#: Tokens of the check's observation: text, two of an image, text that is padding.
CHECK_IMAGE = (False, True, True, False)
CHECK_ATTENDED = (True, True, True, False)

#: What options of real-time chunking say, in the released names.
CHUNKING_OPTIONS = ("action_horizon", "rtc_overlap_steps", "rtc_frozen_steps", "rtc_ramp_rate")


def accelerate(
    policy: object,
    *,
    precision: str = "float32",
    num_threads: int | None = None,
    embodiment_ids: Sequence[int] | None = None,
) -> Accelerated:
    """Lets the action head of a torch policy compute in saccade, on the CPU.

    The head's `get_action` is replaced on this instance: same arguments, same results, the noise drawn from
    torch's generator as the original draws it, so that equal seeds give equal actions up to rounding. Nothing
    else of the policy changes, and :meth:`Accelerated.restore` puts the original back. Before it returns, the
    original runs once on four random tokens and must agree.

    Heads are known by their structure: lerobot's and Isaac-GR00T's, N1.5 to N1.7, and forks that
    :meth:`ActionHead.load` reads. The torch weights stay where they are; saccade's own copy of them takes
    ``handle.head.nbytes`` beside them.

    Args:
        policy: lerobot's `GrootPolicy`, Isaac-GR00T's policy or model, or the head itself.
        precision: As in :meth:`ActionHead.load`. ``"float32"`` is exact to rounding for weights of any type.
        num_threads: As in :meth:`ActionHead.load`.
        embodiment_ids: The embodiments to take weights of; default all. Another id is then an error.

    Raises:
        InputError: there is not one head in `policy`; it is in training mode, compiled, quantised, hooked,
            replaced or accelerated already; the original computes something else.
        CheckpointError: its weights are not those of a GR00T head; all that is wrong is listed.
    """
    module = heads.find(policy)
    if isinstance(vars(module).get("get_action"), Accelerated):
        raise InputError(f"policy: its {type(module).__name__} is accelerated already: restore() it first")
    handle = Accelerated(module, precision, num_threads, embodiment_ids)
    module.__dict__["get_action"] = handle
    return handle


@dataclass(frozen=True)
class Kinds:
    """What the original makes of inputs of some dtype: the dtypes of its noise and of its actions, and the
    class in which it returns them.
    """

    noise: torch.dtype
    actions: torch.dtype
    result: type[Any]


class Features(dict[str, Any]):
    """Keys as attributes: what heads ask of a BatchFeature, for the check's inputs."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(name) from None


class Accelerated:
    """What stands in the place of a torch head's `get_action`, and the handle to it. Made by
    :func:`accelerate`; for any number of threads.

    The head's weights may change: they are compared before each call, as far as
    :class:`saccade.integrations.weights.Watch` says, and taken anew if they have. That takes as long as
    loading did. An edit that it cannot see, of some values through ``.data``, needs :meth:`refresh`. Copies
    and pickles of the policy hold the original `get_action`.

    As a context manager it restores the original at the end.
    """

    def __init__(
        self,
        module: nn.Module,
        precision: str,
        num_threads: int | None,
        embodiment_ids: Sequence[int] | None,
    ) -> None:
        # Weak, since the module holds this object: a cycle would keep gigabytes until the next collection.
        self._weak_module = weakref.ref(module)
        self._options: dict[str, Any] = {
            "precision": precision,
            "num_threads": num_threads,
            "embodiment_ids": embodiment_ids,
        }
        self._takes_options = heads.takes_options(module)
        self._lock = threading.RLock()
        self._restored = False
        self._head: ActionHead | None = None
        self._watch: Watch | None = None
        self._load(module)

    @property
    def module(self) -> nn.Module:
        """The torch head.

        Raises:
            InputError: it is gone, or has been restored.
        """
        module = self._weak_module()
        if module is None or self._restored:
            raise InputError("the head is no longer accelerated: it was restored, or its policy is gone")
        return module

    @property
    def head(self) -> ActionHead:
        """saccade's head with the weights of now, to look inside:
        ``handle.head.trace(handle.head.encode(features), ...)``.

        Raises:
            InputError: as :attr:`module`, and as :func:`accelerate` where the weights have changed.
        """
        return self._current(self.module)

    def refresh(self) -> None:
        """Takes the weights anew. Only edits that the comparison cannot see need it.

        Raises:
            InputError, CheckpointError: as :func:`accelerate`.
        """
        with self._lock:
            self._load(self.module)

    def restore(self) -> None:
        """Puts the original `get_action` back and frees saccade's weights; the second time it does nothing.

        Raises:
            InputError: something else has taken its place since.
        """
        module = self._weak_module()
        if module is None or self._restored:
            return
        now = vars(module).get("get_action")
        if now is not self:
            raise InputError(
                f"get_action was replaced since by {heads.describe(now)}: take that away first, then restore"
            )
        del module.__dict__["get_action"]
        with self._lock:
            self._restored = True
            self._head = self._watch = None

    def __enter__(self) -> Accelerated:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.restore()

    def __call__(
        self, backbone_output: Any, action_input: Any, options: Mapping[str, Any] | None = None
    ) -> Any:
        """As the head's own `get_action`.

        Args:
            backbone_output: `backbone_features (batch, T_vl, context_dim)`, which is replaced by what the VL
                self-attention makes of it, as the original does; heads with image and text blocks also take
                `backbone_attention_mask` and `image_mask`, bool `(batch, T_vl)`.
            action_input: `state (batch, state_history, state_dim)`, `embodiment_id (batch,)`; with real-time
                chunking `action`, the previous chunk.
            options: of real-time chunking, for heads that have it.

        Returns:
            The original's class with `action_pred (batch, action_horizon, action_dim)`, of the original's
            dtype and device; from N1.6 on also `backbone_features` and `state_features`.

        Raises:
            InputError: training mode, hooks, gradients asked for; as :meth:`ActionHead.encode` and
                :meth:`ActionHead.sample`.
        """
        import torch

        if options is not None and not self._takes_options:
            raise TypeError("get_action of this head takes no options")
        module = self.module
        if problems := list(heads.in_use([("", module), *self._parts])):
            raise InputError(f"{type(module).__name__}.get_action: {'; '.join(problems)}")
        features, state = backbone_output["backbone_features"], action_input["state"]
        if torch.is_grad_enabled() and (features.requires_grad or state.requires_grad):
            raise InputError(
                "backbone_features and state: expected tensors without gradient, since saccade computes "
                "none; call get_action under torch.no_grad(), detach() them, or restore() the original"
            )
        with torch.no_grad():
            head = self._current(module)
            kinds = self._kinds_of(module, head, features, state)
            chunk = self._chunk(action_input, options, kinds.noise)
            noise = draw(head.config, features.shape[0], kinds.noise, features.device)
            actions, vl_embs = run(module, head, backbone_output, action_input, noise, chunk)
            vl_embs = vl_embs.to(features.device, kinds.noise)
            results = {"action_pred": actions.to(features.device, kinds.actions)}
            if head.config.version not in ("n1", "n1.5"):
                rows = state.reshape(state.shape[0], 1, -1)
                results["backbone_features"] = vl_embs
                results["state_features"] = module.state_encoder(rows, action_input["embodiment_id"])  # type: ignore[operator]
            backbone_output["backbone_features"] = vl_embs
            return kinds.result(data=results)

    def __deepcopy__(self, memo: dict[int, Any]) -> MethodType:
        """A copy of the policy has the original `get_action`."""
        return copy.deepcopy(self._original(), memo)

    def __reduce__(self) -> tuple[Any, ...]:
        """So has a pickle: while the module is being read, this name is still its class's."""
        return getattr, (self.module, "get_action")

    def __repr__(self) -> str:
        module = self._weak_module()
        if module is None or self._restored:
            return "<saccade.integrations.Accelerated, restored>"
        return f"<saccade.integrations.Accelerated {type(module).__name__} {self._options}>"

    def _original(self) -> MethodType:
        module = self.module
        return MethodType(type(module).get_action, module)  # type: ignore[attr-defined]

    def _load(self, module: nn.Module) -> None:
        """Takes the head's weights, and checks what is made of them against the original."""
        import torch

        self._head = None  # first, so that two copies are never in memory
        heads.check(module, self)
        # Before the weights are read: what changes while they are is seen at the next call.
        self._watch = Watch(module)
        self._settings = heads.settings_of(module)
        self._parts = list(module.named_modules())[1:]  # without itself, which must not be held
        self._kinds: dict[tuple[Any, ...], Kinds] = {}
        head = ActionHead.from_tensors(tensors_of(module), config=heads.config_of(module), **self._options)
        parameters = list(module.parameters())
        # Of mixed dtypes the original takes inputs under autocast only.
        mixed = len({parameter.dtype for parameter in parameters}) > 1
        like = parameters[0].detach()
        with torch.no_grad(), torch.autocast(like.device.type, torch.bfloat16, enabled=mixed):
            self._kinds_of(module, head, like, like)
        self._head = head

    def _current(self, module: nn.Module) -> ActionHead:
        """The head with the weights of now."""
        # In this order, so that a load in another thread can make this one look stale but not current.
        watch, head = self._watch, self._head
        if head is None or watch is None or self._settings != heads.settings_of(module) or watch.changed():
            with self._lock:
                # Unless another thread has loaded it in the meantime.
                if self._head is None or self._head is head:
                    self._load(self.module)
                head = self._head
        assert head is not None
        return head

    def _kinds_of(self, module: nn.Module, head: ActionHead, features: Tensor, state: Tensor) -> Kinds:
        """What the original makes of inputs of these dtypes under the autocast of now. The first time it is
        asked, on four tokens; saccade must agree."""
        import torch

        device = features.device.type
        autocast = torch.is_autocast_enabled(device) and torch.get_autocast_dtype(device)
        key = (features.dtype, state.dtype, device, autocast)
        if key not in self._kinds:
            reduced = bool(autocast) or features.dtype != torch.float32
            rounded = reduced or self._options["precision"] != "float32"
            inputs = check_inputs(module, head, features, state)
            self._kinds[key] = agree(module, head, inputs, rounded)
        return self._kinds[key]

    def _chunk(
        self, action_input: Any, options: Mapping[str, Any] | None, dtype: torch.dtype
    ) -> dict[str, Any]:
        """Arguments of `sample` for real-time chunking, as the original reads them."""
        if "action" not in action_input:
            return {}
        if not self._takes_options:
            if getattr(self.module, "inference_rtc_overlap_steps", None) is not None:
                raise InputError(
                    "action: this head's own real-time chunking is not known to saccade; leave action out, "
                    "or restore() the original"
                )
            return {}
        missing = [name for name in CHUNKING_OPTIONS if name not in (options or {})]
        if options is None or missing:
            raise InputError(
                f"options: real-time chunking, which action asks for, needs {', '.join(missing)}"
            )
        horizon, overlap = int(options["action_horizon"]), int(options["rtc_overlap_steps"])
        if overlap == 0:
            return {}
        frozen, ramp_rate = int(options["rtc_frozen_steps"]), float(options["rtc_ramp_rate"])
        return {
            "previous_chunk": action_input["action"][:, :horizon].to("cpu", dtype),
            "chunking": Chunking(overlap, frozen, ramp_rate, horizon),
        }


def draw(config: HeadConfig, batch: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The noise `(batch, action_horizon, encoder_action_dim)`, drawn as the original draws it."""
    import torch

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
    """Actions and vision-language tokens in float32 on the CPU, from what the original takes."""
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
    """The embodiment whose decoders have the largest weights: one that was trained, if any was."""
    import torch

    decoders = [
        parameter for name, parameter in module.named_parameters() if name.endswith("decoder.layer2.W")
    ]
    sizes = {
        index: sum(float(torch.linalg.vector_norm(weight[index].float())) for weight in decoders)
        for index in embodiment_ids
    }
    return max(sizes, key=lambda index: sizes[index])


def check_inputs(
    module: nn.Module, head: ActionHead, features: Tensor, state: Tensor
) -> tuple[Features, Features]:
    """A random observation of four tokens, in the dtypes and on the device of others."""
    import torch

    config, generator = head.config, torch.Generator().manual_seed(0)
    tokens = torch.randn(1, len(CHECK_IMAGE), config.context_dim, generator=generator)
    rows = torch.randn(1, config.state_history, config.state_dim, generator=generator)
    backbone_output = Features(
        backbone_features=tokens.to(features),
        backbone_attention_mask=torch.tensor([CHECK_ATTENDED], device=features.device),
        image_mask=torch.tensor([CHECK_IMAGE], device=features.device),
    )
    ids = torch.tensor([most_active(module, head.embodiment_ids)], device=features.device)
    return backbone_output, Features(state=rows.to(state), embodiment_id=ids)


def agree(module: nn.Module, head: ActionHead, inputs: tuple[Features, Features], rounded: bool) -> Kinds:
    """Runs the original and saccade on the same inputs from the same state of torch's generator. `rounded`
    says that one of the two rounds to 8 bits.

    Raises:
        InputError: they do not agree: in the actions, or in how they draw noise.
    """
    import torch

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
            f"{name} cannot be accelerated: its get_action draws other random numbers than the noise"
        )
    theirs = result["action_pred"]
    ours, _ = run(module, head, backbone_output, action_input, noise, {})
    expected, start = theirs.float().cpu(), noise.float().cpu()[..., : theirs.shape[-1]]
    share = ROUNDED_TOLERANCE if rounded else EXACT_TOLERANCE
    rounding = ROUNDED_ROUNDING if rounded else EXACT_ROUNDING
    norm = torch.linalg.vector_norm
    allowed = float(share * norm(expected - start) + rounding * norm(start))
    error = float(norm(ours - expected)) if ours.shape == expected.shape else math.inf
    if not error <= allowed:
        raise InputError(
            f"{name} cannot be accelerated: on random inputs its get_action gives other actions than "
            f"saccade; the norm of the difference is {error:.1e}, expected at most {allowed:.1e}"
        )
    return Kinds(dtype, theirs.dtype, type(result))


def generator_state(device: torch.device) -> Tensor:
    """The state of torch's generator of this device."""
    import torch

    return torch.cuda.get_rng_state(device) if device.type == "cuda" else torch.get_rng_state()
