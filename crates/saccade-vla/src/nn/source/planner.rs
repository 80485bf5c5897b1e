//! A back end that notes what a model asks for: its tensors, and the order in which it reads them.

use std::cell::RefCell;
use std::collections::BTreeSet;

use saccade_vla_checkpoint::{TensorSpec, Wanted};

use crate::error::Result;
use crate::nn::weights::{Request, Source, Stored, Tensor};

/// Notes every request.
#[derive(Default)]
pub(crate) struct Planner {
    plan: RefCell<Plan>,
}

/// What a model asks for.
#[derive(Default)]
pub(crate) struct Plan {
    /// Every tensor once, in the order in which it is first asked for.
    pub specs: Vec<TensorSpec>,
    /// All that is read, in its order.
    pub wanted: Vec<Wanted>,
    names: BTreeSet<String>,
}

impl Planner {
    pub(crate) fn into_plan(self) -> Plan {
        self.plan.into_inner()
    }
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
