//! A back end that notes the requests of a model: its tensors, and the order in which it reads them.

use std::cell::RefCell;
use std::collections::BTreeSet;

use saccade_vla_checkpoint::{TensorSpec, Wanted};
use saccade_vla_kernels::Isa;

use super::{Request, Source, Stored, Tensor};
use crate::engine::Engine;
use crate::error::Result;
use crate::nn::weights::{self, Weights};
use crate::precision::Precision;

/// Notes every request.
#[derive(Default)]
struct Planner {
    plan: RefCell<Plan>,
}

/// The requests of a model.
#[derive(Default)]
pub(crate) struct Plan {
    /// Every tensor once, in the order in which it is first asked for.
    pub specs: Vec<TensorSpec>,
    /// All that is read, in its order.
    pub wanted: Vec<Wanted>,
    names: BTreeSet<String>,
}

/// The requests of the layers that `build` makes.
pub(crate) fn plan<L>(build: impl FnOnce(&Weights<'_>) -> Result<L>) -> Result<Plan> {
    let planner = Planner::default();
    let engine = Engine {
        isa: Isa::best(),
        threads: 1,
        precision: Precision::default(),
    };
    weights::build(&planner, engine, build)?;
    Ok(planner.plan.into_inner())
}

impl Source for Planner {
    fn tensor(&self, request: &Request) -> Result<Tensor> {
        let mut plan = self.plan.borrow_mut();
        let spec = &request.spec;
        if !spec.shape.contains(&0) {
            plan.wanted.push(Wanted {
                name: spec.name.clone(),
                slices: request.slices.clone(),
                is_given_back: request.is_given_back,
            });
        }
        if plan.names.insert(spec.name.clone()) {
            plan.specs.push(spec.clone());
        }
        Ok(Tensor::Outline(Stored::F32))
    }
}
