"""ggml's matrix product, from the library that llama-cpp-python ships, through its C interface."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from ctypes import POINTER, c_bool, c_float, c_int, c_int64, c_size_t, c_void_p
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benches.peers.cases import LINEAR_SHAPES
from benches.peers.engines import Built, Task
from benches.peers.engines.graphs import WEIGHT_BYTES

TYPES = {"float32": 0, "float16": 1, "int8": 8, "bfloat16": 30}  # ggml_type; int8 is Q8_0
F32 = TYPES["float32"]
TENSORS = 64  # at most, in a graph


class InitParams(ctypes.Structure):
    """`ggml_init_params`."""

    _fields_ = (("mem_size", c_size_t), ("mem_buffer", c_void_p), ("no_alloc", c_bool))


def library() -> Any:
    """The functions used here, with their types. `SACCADE_PEERS_GGML` names the folder of the library."""
    folder = Path(os.environ["SACCADE_PEERS_GGML"])
    for name in ("libggml-base.so", "libggml-cpu.so", "libggml.so"):
        loaded = ctypes.CDLL(str(folder / name), mode=ctypes.RTLD_GLOBAL)
    pointers = {
        "ggml_init": [InitParams],
        "ggml_new_tensor_2d": [c_void_p, c_int, c_int64, c_int64],
        "ggml_mul_mat": [c_void_p] * 3,
        "ggml_new_graph": [c_void_p],
        "ggml_get_data": [c_void_p],
        "ggml_backend_cpu_init": [],
        "ggml_backend_alloc_ctx_tensors": [c_void_p] * 2,
    }
    for name, arguments in pointers.items():
        getattr(loaded, name).argtypes = arguments
        getattr(loaded, name).restype = c_void_p
    loaded.ggml_build_forward_expand.argtypes = [c_void_p] * 2
    loaded.ggml_build_forward_expand.restype = None
    loaded.ggml_backend_cpu_set_n_threads.argtypes = [c_void_p, c_int]
    loaded.ggml_backend_cpu_set_n_threads.restype = None
    loaded.ggml_backend_graph_compute.argtypes = [c_void_p] * 2
    loaded.ggml_nbytes.argtypes, loaded.ggml_nbytes.restype = [c_void_p], c_size_t
    loaded.ggml_backend_tensor_set.argtypes = [c_void_p, c_void_p, c_size_t, c_size_t]
    loaded.ggml_backend_tensor_set.restype = None
    loaded.ggml_backend_tensor_get.argtypes = [c_void_p, c_void_p, c_size_t, c_size_t]
    loaded.ggml_backend_tensor_get.restype = None
    loaded.ggml_quantize_chunk.restype = c_size_t
    loaded.ggml_quantize_chunk.argtypes = [
        c_int,
        POINTER(c_float),
        c_void_p,
        c_int64,
        c_int64,
        c_int64,
        c_void_p,
    ]
    return loaded


def build(task: Task) -> Built:
    """The works of the linear layers. Options: `arithmetic`, a key of `TYPES`."""
    ggml, kind = library(), TYPES[task.options["arithmetic"]]
    backend = ggml.ggml_backend_cpu_init()
    ggml.ggml_backend_cpu_set_n_threads(backend, task.case.threads)
    works: dict[str, Callable[[], Any]] = {}
    calls: dict[str, int] = {}
    results: list[Callable[[], NDArray[np.float32]]] = []
    for index, (name, shape) in enumerate(zip(task.case.works, LINEAR_SHAPES, strict=True)):
        rows, inputs, outputs = shape
        copies = max(2, WEIGHT_BYTES // (4 * inputs * outputs))
        weight, x = task.arrays[f"w{index}"], task.arrays[f"x{index}"]
        context = ggml.ggml_init(InitParams(1 << 22, None, True))
        graph = ggml.ggml_new_graph(context)
        given = ggml.ggml_new_tensor_2d(context, F32, inputs, rows)
        weights = [ggml.ggml_new_tensor_2d(context, kind, inputs, outputs) for _ in range(copies)]
        products = [ggml.ggml_mul_mat(context, each, given) for each in weights]
        for product in products:
            ggml.ggml_build_forward_expand(graph, product)
        if not ggml.ggml_backend_alloc_ctx_tensors(context, backend):
            raise MemoryError(f"ggml could not allocate {name}")
        narrow = np.empty(ggml.ggml_nbytes(weights[0]), np.uint8)
        source = np.ascontiguousarray(weight).ctypes.data_as(POINTER(c_float))
        ggml.ggml_quantize_chunk(kind, source, narrow.ctypes.data, 0, outputs, inputs, None)
        for each in weights:
            ggml.ggml_backend_tensor_set(each, narrow.ctypes.data, 0, narrow.nbytes)
        ggml.ggml_backend_tensor_set(given, np.ascontiguousarray(x).ctypes.data, 0, x.nbytes)

        def run(graph: Any = graph) -> None:
            if ggml.ggml_backend_graph_compute(backend, graph) != 0:
                raise RuntimeError("ggml: the graph could not be computed")

        def result(
            run: Callable[[], Any] = run, product: Any = products[0], shape: tuple[int, int] = (rows, outputs)
        ) -> NDArray[np.float32]:
            run()
            out = np.empty(shape, np.float32)
            ggml.ggml_backend_tensor_get(product, out.ctypes.data, 0, out.nbytes)
            return out.ravel()

        works[name], calls[name] = run, copies
        results.append(result)
    return Built(works, lambda: np.concatenate([result() for result in results]), calls)
