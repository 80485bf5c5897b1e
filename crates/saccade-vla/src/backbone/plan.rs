//! The tensors of a backbone without the backbone: what its checkpoint must hold, in which order it is read, and how large it will be.

use saccade_vla_checkpoint::Dtype;
use saccade_vla_kernels::Isa;

use super::layers::BackboneLayers;
use super::recognise::Recognised;
use crate::engine::Engine;
use crate::error::Result;
use crate::nn::source::planner::{Plan, Planner};
use crate::nn::source::sizer::Sizer;
use crate::nn::weights::Builder;
use crate::precision::Precision;

/// What a backbone reads: its tensors by name without a prefix, and their order.
pub(super) fn plan(found: &Recognised) -> Result<Plan> {
    let planner = Planner::default();
    let engine = Engine {
        isa: Isa::best(),
        threads: 1,
        precision: Precision::default(),
    };
    BackboneLayers::new(
        &Builder::new(&planner, engine).weights(),
        &found.names,
        &found.config,
    )?;
    Ok(planner.into_plan())
}

/// Bytes of the layers of a backbone whose tensors are stored as `dtype` says by name.
pub(super) fn nbytes(
    found: &Recognised,
    engine: Engine,
    dtype: impl Fn(&str) -> Result<Dtype>,
) -> Result<usize> {
    let sizer = Sizer::new(engine, dtype);
    let builder = Builder::new(&sizer, engine);
    BackboneLayers::new(&builder.weights(), &found.names, &found.config)?;
    Ok(builder.nbytes())
}
