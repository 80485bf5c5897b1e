//! Python bindings of saccade: arrays become views, the interpreter is released, errors are mapped. No logic: values are checked in the
//! `saccade` crate, kinds of arrays in the Python package.

#![deny(unsafe_code)]

mod arrays;
mod attention;
mod backbone;
mod checkpoint;
mod config;
mod context;
mod detached;
mod error;
mod head;
mod intervention;
mod linalg;
mod machine;
mod policy;
mod processor;
mod rewrite;
mod rounding;

use pyo3::prelude::*;

#[pymodule(gil_used = false)]
mod _saccade {
    #[pymodule_export]
    use crate::attention::{CrossAttention, KeyValues};
    #[pymodule_export]
    use crate::backbone::{Backbone, BackboneCheckpoint, BackboneFeatures};
    #[pymodule_export]
    use crate::checkpoint::{HeadCheckpoint, read_stored, read_tensors, tensor_names};
    #[pymodule_export]
    use crate::config::{parse_config, tensor_shapes};
    #[pymodule_export]
    use crate::context::Context;
    #[pymodule_export]
    use crate::detached::panic_in_core;
    #[pymodule_export]
    use crate::head::ActionHead;
    #[pymodule_export]
    use crate::linalg::{Pca, Ridge, Standardizer, linear_cka, principal_angles};
    #[pymodule_export]
    use crate::machine::{
        PyProfile, StayOnThisThread, available_isas, cpu_report, default_num_threads, dot_products,
        measure_peaks, selected_isa,
    };
    #[pymodule_export]
    use crate::policy::Policy;
    #[pymodule_export]
    use crate::processor::{Processor, ProcessorSource};
    #[pymodule_export]
    use crate::rewrite::{convert, merge_future_tokens, quantize, quantized_weights, resize};
    #[pymodule_export]
    use crate::rounding::{Gram, WatchLinears, gptq, round_layer, rounded_layer};

    #[pymodule_export]
    #[allow(non_upper_case_globals)]
    const __version__: &str = env!("CARGO_PKG_VERSION");
}
