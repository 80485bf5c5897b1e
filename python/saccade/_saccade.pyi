"""The extension module: what the Python package calls. Arrays are C-contiguous."""

from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import StoredTensor

_Float32 = npt.NDArray[np.float32]
_Bool = npt.NDArray[np.bool_]
_Bytes = npt.NDArray[np.uint8]  # of a mask: 0 is False
_Int64 = npt.NDArray[np.int64]
_Float64 = npt.NDArray[np.float64]
_Frame = npt.NDArray[np.uint8] | npt.NDArray[np.float32] | npt.NDArray[np.float64]
# The views with their names, whether they are in the order of the prompt, the instruction.
_Observation = tuple[list[tuple[str | None, _Frame]], bool, str | None]

_Recorded = tuple[dict[Any, _Float32], dict[Any, _Float32]]  # attention and hidden rows, by place
# rows by layer, and by observation and view the patches and the tokens
_BackboneRecorded = tuple[list[_Float32], list[list[_Float32]], list[list[_Float32]]]
_Intervention = dict[str, Any]  # the fields of saccade.Intervention, mappings as lists of their items

__all__ = [
    "PCA",
    "ActionHead",
    "Backbone",
    "BackboneCheckpoint",
    "BackboneFeatures",
    "Context",
    "CrossAttention",
    "Gram",
    "HeadCheckpoint",
    "KeyValues",
    "Policy",
    "Processor",
    "ProcessorSource",
    "Ridge",
    "Standardizer",
    "__version__",
    "available_isas",
    "convert",
    "cpu_report",
    "default_num_threads",
    "dot_products",
    "gptq",
    "linear_cka",
    "measure_peaks",
    "merge_future_tokens",
    "panic_in_core",
    "parse_config",
    "principal_angles",
    "profile",
    "quantize",
    "quantized_weights",
    "read_stored",
    "read_tensors",
    "resize",
    "round_layer",
    "rounded_layer",
    "selected_isa",
    "stay_on_this_thread",
    "tensor_names",
    "tensor_shapes",
    "watch_linears",
]

__version__: str

@final
class Context:
    @property
    def batch(self) -> int: ...
    @property
    def num_vl_tokens(self) -> int: ...
    @property
    def nbytes(self) -> int: ...
    def vl_embs(self) -> _Float32: ...
    def image_mask(self) -> _Bool | None: ...

@final
class ActionHead:
    @staticmethod
    def load(
        source: str,
        config: str | None,
        embodiment_ids: list[int] | None,
        action_horizon: int | None,
        num_states: int | None,
        precision: str,
        num_threads: int | None,
    ) -> ActionHead: ...
    @staticmethod
    def from_tensors(
        tensors: dict[str, StoredTensor],
        config: str,
        embodiment_ids: list[int] | None,
        num_states: int | None,
        precision: str,
        num_threads: int | None,
    ) -> ActionHead: ...
    def config(self) -> dict[str, Any]: ...
    @property
    def embodiment_ids(self) -> list[int]: ...
    def future_tokens(self) -> _Float32: ...
    @property
    def num_threads(self) -> int: ...
    @property
    def precision(self) -> str: ...
    @property
    def isa(self) -> str: ...
    @property
    def nbytes(self) -> int: ...
    def warmup(
        self, num_vl_tokens: int, batch: int, num_samples: int | None, future_refresh: int | None
    ) -> None: ...
    def encode(
        self,
        backbone_features: _Float32,
        attention_mask: _Bytes | None,
        image_mask: _Bytes | None,
        drop_vl: _Bytes | None,
        attention: bool,
        hidden: bool,
    ) -> tuple[Context, _Recorded]: ...
    def encode_features(self, features: list[BackboneFeatures]) -> Context: ...
    def sample(
        self,
        context: Context,
        state: _Float32,
        embodiment_id: _Int64,
        noise: _Float32,
        num_steps: int | None,
        integrator: str,
        num_samples: int | None,
        future_refresh: int | None,
        previous_chunk: _Float32 | None,
        chunking: tuple[int, int, float, int | None] | None,
        guidance: tuple[float, Context] | None,
        intervention: list[_Intervention],
        out: _Float32,
    ) -> None: ...
    def trace(
        self,
        context: Context,
        state: _Float32,
        embodiment_id: _Int64,
        noise: _Float32,
        num_steps: int | None,
        intervention: list[_Intervention],
        attention: bool,
        hidden: bool,
        blocks: tuple[int, ...] | None,
        steps: tuple[int, ...] | None,
        max_bytes: int,
    ) -> tuple[_Recorded, dict[str, tuple[int, int]], _Float32]: ...
    def velocity(
        self,
        context: Context,
        state: _Float32,
        embodiment_id: _Int64,
        actions: _Float32,
        timestep: _Int64,
        intervention: list[_Intervention],
        out: _Float32,
    ) -> None: ...

@final
class BackboneFeatures:
    @property
    def nbytes(self) -> int: ...
    @property
    def shape(self) -> tuple[int, int]: ...
    @property
    def num_views(self) -> int: ...
    def features(self) -> _Float32: ...
    def masks(self) -> list[_Bool]: ...
    def views(self) -> list[list[_Int64]]: ...

@final
class Backbone:
    @staticmethod
    def load(source: str, config: str | None, precision: str, num_threads: int | None) -> Backbone: ...
    @staticmethod
    def from_tensors(
        tensors: dict[str, StoredTensor], config: str | None, precision: str, num_threads: int | None
    ) -> Backbone: ...
    def config(self) -> dict[str, Any]: ...
    @property
    def num_threads(self) -> int: ...
    @property
    def precision(self) -> str: ...
    @property
    def isa(self) -> str: ...
    @property
    def nbytes(self) -> int: ...
    def encode(
        self,
        inputs: list[dict[str, Any]],  # the fields of saccade.BackboneInputs, pixel_values as a list
        previous: list[BackboneFeatures],
        hidden: bool,
        vision: bool,
        image_tokens: bool,
    ) -> list[tuple[BackboneFeatures, _BackboneRecorded]]: ...

@final
class BackboneCheckpoint:
    @staticmethod
    def open(source: str, config: str | None) -> BackboneCheckpoint: ...
    def config(self) -> dict[str, Any]: ...
    @property
    def prefix(self) -> str: ...
    def nbytes(self, precision: str) -> int: ...

@final
class Processor:
    def __new__(
        cls,
        version: str,
        tokenizer: str,
        preprocessing: str | None,
        image_size: int | None,
        tokens_per_view: int | None,
        plain_text: bool,
        options: str | None,
    ) -> Processor: ...
    @staticmethod
    def load(
        source: ProcessorSource, tokenizer: str | None, preprocessing: str | None, options: str | None
    ) -> Processor: ...
    @property
    def version(self) -> str: ...
    @property
    def preprocessing(self) -> str: ...
    @property
    def view_size(self) -> tuple[int, int] | None: ...
    @property
    def num_tokens(self) -> int: ...
    @property
    def image_token_id(self) -> int: ...
    def frame(self, image: _Frame) -> _Float32: ...
    def tokens(self, text: str) -> _Int64: ...
    def texts(self, ids: list[int]) -> list[str]: ...
    def process(
        self,
        observations: list[_Observation],
        plain_text: bool,
    ) -> tuple[list[_Float32], _Int64, _Bool, _Int64 | None, list[str] | None]: ...

@final
class Policy:
    def __new__(cls, processor: Processor, backbone: Backbone, head: ActionHead) -> Policy: ...
    def encode(
        self,
        observations: list[tuple[_Observation, bool]],  # and whether the instruction is plain text
        previous: tuple[Context, list[BackboneFeatures]] | None,
    ) -> tuple[Context, list[BackboneFeatures]]: ...

@final
class ProcessorSource:
    def __new__(cls, source: str) -> ProcessorSource: ...
    @property
    def version(self) -> str: ...
    @property
    def has_tokenizer(self) -> bool: ...
    @property
    def published(self) -> list[str]: ...
    @property
    def needed_files(self) -> list[str]: ...

@final
class KeyValues:
    @property
    def batch(self) -> int: ...
    @property
    def num_vl_tokens(self) -> int: ...
    @property
    def nbytes(self) -> int: ...

@final
class CrossAttention:
    def __new__(cls, tensors: dict[str, _Float32], num_heads: int, precision: str) -> CrossAttention: ...
    @property
    def width(self) -> int: ...
    @property
    def context_dim(self) -> int: ...
    @property
    def num_heads(self) -> int: ...
    @property
    def precision(self) -> str: ...
    @property
    def nbytes(self) -> int: ...
    def project(self, encoder_hidden_states: _Float32) -> KeyValues: ...
    def attend(
        self,
        hidden_states: _Float32,
        kv: KeyValues,
        key_mask: _Bytes | None,
        key_bias: _Float32 | None,
        weights: _Float32 | None,
        out: _Float32,
    ) -> None: ...

@final
class Standardizer:
    @staticmethod
    def fit(x: _Float64, scaled: bool) -> Standardizer: ...
    @property
    def mean(self) -> _Float64: ...
    @property
    def scale(self) -> _Float64: ...
    def transform(self, x: _Float64) -> _Float64: ...

@final
class PCA:
    @staticmethod
    def fit(x: _Float64, components: int) -> PCA: ...
    @property
    def mean(self) -> _Float64: ...
    @property
    def components(self) -> _Float64: ...
    @property
    def explained_variance(self) -> _Float64: ...
    @property
    def total_variance(self) -> float: ...
    def transform(self, x: _Float64) -> _Float64: ...

@final
class Ridge:
    @staticmethod
    def fit(x: _Float64, y: _Float64, alphas: _Float64) -> Ridge: ...
    @property
    def weights(self) -> _Float64: ...
    @property
    def intercepts(self) -> _Float64: ...
    def predict(self, x: _Float64) -> _Float64: ...

def linear_cka(x: _Float64, y: _Float64) -> float: ...
def principal_angles(a: _Float64, b: _Float64) -> _Float64: ...

@final
class HeadCheckpoint:
    @staticmethod
    def open(source: str, config: str | None) -> HeadCheckpoint: ...
    @staticmethod
    def open_base(source: str, config: str | None, adapter: str | None) -> HeadCheckpoint: ...
    def config(self) -> dict[str, Any]: ...
    @property
    def config_json(self) -> str: ...
    @property
    def layout(self) -> str: ...
    @property
    def prefix(self) -> str: ...
    @property
    def evidence(self) -> list[str]: ...
    @property
    def files(self) -> list[Path]: ...
    @property
    def metadata(self) -> dict[str, str]: ...
    def kept_embodiments(self) -> list[int] | None: ...
    def tensors(self) -> list[tuple[str, str, list[int], int]]: ...  # name, type, shape, bytes in the file
    def check(self) -> None: ...
    def read(self, name: str, index: int | None) -> _Float32: ...
    def nbytes(self, precision: str, num_embodiments: int) -> int: ...

@final
class profile:
    def __new__(cls) -> profile: ...
    def __enter__(self) -> profile: ...
    def __exit__(self, *_error: object) -> None: ...
    def counters(self) -> dict[str, tuple[int, float, int, int]]: ...  # calls, seconds, multiply-adds, bytes
    def kernels(self) -> dict[str, str]: ...  # of linear layers, by part

@final
class stay_on_this_thread:
    def __new__(cls) -> stay_on_this_thread: ...
    def __enter__(self) -> None: ...
    def __exit__(self, *_error: object) -> None: ...

def parse_config(text: str, num_states: int | None = None) -> dict[str, Any]: ...
def read_stored(source: str) -> dict[str, tuple[str, list[int], bytes]]: ...  # dtype, shape, content
def read_tensors(source: str, prefix: str) -> dict[str, _Float32]: ...
def tensor_names(source: str) -> list[str]: ...
def quantize(rewrite: dict[str, Any], to: str) -> dict[str, Any]: ...
def quantized_weights(
    rewrite: dict[str, Any],
) -> tuple[str, str | None, set[str]]: ...  # prefixes of head and backbone; names
def convert(
    rewrite: dict[str, Any], embodiment_ids: list[int] | None, dtype: str | None, adapter: str | None
) -> dict[str, Any]: ...
def resize(
    rewrite: dict[str, Any], num_future_tokens: int, perturbation: float, seed: int
) -> dict[str, Any]: ...
def merge_future_tokens(
    tokens: _Float32, num_future_tokens: int, key_bias: list[float] | None = None
) -> tuple[_Float32, list[list[int]], list[float] | None]: ...  # rows, their tokens, key biases

@final
class Gram:
    def __new__(cls, width: int) -> Gram: ...
    @property
    def width(self) -> int: ...
    @property
    def num_rows(self) -> int: ...
    def add(self, x: _Float32, num_threads: int) -> None: ...
    def matrix(self) -> _Float32: ...

def gptq(
    weight: _Float32, scales: _Float32, gram: Gram, num_threads: int
) -> tuple[npt.NDArray[np.int8], dict[str, float]]: ...  # whole numbers; errors of the outputs
def round_layer(
    checkpoint: HeadCheckpoint, names: list[str], gram: Gram, out: str, num_threads: int
) -> dict[str, float]: ...  # errors of the outputs
def rounded_layer(directory: str) -> tuple[list[str], dict[str, float]]: ...  # weights, errors

@final
class watch_linears:
    def __new__(cls, wanted: list[str]) -> watch_linears: ...
    def __enter__(self) -> watch_linears: ...
    def __exit__(self, error: object, *_about: object) -> None: ...
    def layers(self) -> list[tuple[list[str], int, Gram | None]]: ...  # weights, inputs, of those wanted

def available_isas() -> list[str]: ...
def selected_isa() -> str: ...
def dot_products() -> list[str]: ...
def cpu_report() -> tuple[str, str, str]: ...  # family, whose rates, tiles
def default_num_threads() -> int: ...
def measure_peaks(num_threads: int) -> dict[str, Any]: ...
def tensor_shapes(text: str) -> list[tuple[str, list[int]]]: ...
def panic_in_core(message: str) -> None: ...
