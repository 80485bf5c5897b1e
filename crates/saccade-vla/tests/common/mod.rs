//! What several tests share: files of the repository, heads made of them, numbers, and calls.

// Each test uses some of it.
#![allow(dead_code)]

pub mod interventions;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use saccade_vla::{
    ActionHead, Array, ArrayMut, Context, ElementsRef, Features, HeadConfig, Intervention, LoadOptions,
    NoisyActions, Result, Sampling, TensorView, TensorViews, Trace, TraceOptions, tensor_shapes,
};

/// Released heads.
pub const HEADS: [&str; 5] = [
    "n15_tiny.safetensors",
    "n15_single_view.safetensors",
    "n15_bf16.safetensors",
    "n17_tiny.safetensors",
    "fork_two_decoders.safetensors",
];

/// A file of the repository.
pub fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(path)
}

/// A file that the tests compare with.
pub fn data(name: &str) -> PathBuf {
    repository("tests/data").join(name)
}

/// The policy that comes with saccade.
pub fn demo() -> PathBuf {
    repository("python/saccade/checkpoints/demo")
}

/// An entry of the metadata of a file.
pub fn metadata(path: &Path, key: &str) -> String {
    let bytes = std::fs::read(path).unwrap();
    let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).unwrap();
    header.metadata().as_ref().unwrap()[key].clone()
}

/// A released head, with the config in the file's metadata.
pub fn released(name: &str, num_threads: usize) -> ActionHead {
    let options = LoadOptions {
        config: Some(metadata(&data(name), "config")),
        num_threads: Some(num_threads),
        ..LoadOptions::default()
    };
    ActionHead::load(&data(name), &options).unwrap()
}

/// Numbers that look random and are the same everywhere, below 1 in size.
pub fn numbers(len: usize, seed: u32) -> Vec<f32> {
    let mut state = seed.wrapping_mul(2_654_435_761).wrapping_add(12345);
    let mut next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 23) as f32 - 1.0
    };
    (0..len).map(|_| next()).collect()
}

/// Tensors by name: their shapes and elements.
pub type Tensors = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

/// A head of these tensors.
pub fn head_of(tensors: &Tensors, config: &str) -> ActionHead {
    let mut views = TensorViews::new();
    for (name, (shape, values)) in tensors {
        let view = TensorView::new(shape, ElementsRef::F32(values)).unwrap();
        views.insert(name.clone(), view);
    }
    let options = LoadOptions {
        config: Some(config.to_owned()),
        num_threads: Some(1),
        ..LoadOptions::default()
    };
    ActionHead::from_tensors(&views, &options).unwrap()
}

/// A head of this config with weights that look random, small enough that no probability underflows.
pub fn made_up(config: &str) -> ActionHead {
    let shapes = tensor_shapes(&HeadConfig::from_json(config).unwrap()).unwrap();
    let tensors = shapes.into_iter().zip(1..).map(|((name, shape), seed)| {
        let values = numbers(shape.iter().product(), seed);
        let values = values.into_iter().map(|value| 0.3 * value).collect();
        (name, (shape, values))
    });
    head_of(&tensors.collect(), config)
}

/// The inputs of calls of a head.
pub struct Inputs<'a> {
    head: &'a ActionHead,
    pub context: Context,
    state: Vec<f32>,
    embodiment_ids: Vec<i64>,
    noise: Vec<f32>,
}

impl<'a> Inputs<'a> {
    /// One observation of `num_vl_tokens` for each of these embodiments. Every third token is an image's.
    pub fn new(head: &'a ActionHead, embodiment_ids: &[i64], num_vl_tokens: usize) -> Self {
        let (config, batch) = (head.config(), embodiment_ids.len());
        let shape = [batch, num_vl_tokens, config.context_dim];
        let features = numbers(shape.iter().product(), 1);
        let image_mask: Vec<_> = (0..batch * num_vl_tokens).map(|token| token % 3 == 1).collect();
        let features = Features {
            image_mask: Some(Array::new(&image_mask, &shape[..2]).unwrap()),
            ..Features::new(Array::new(&features, &shape).unwrap())
        };
        Self {
            head,
            context: head.encode(&features).unwrap(),
            state: numbers(batch * config.num_states * config.state_dim, 3),
            embodiment_ids: embodiment_ids.to_vec(),
            noise: numbers(batch * config.action_horizon * config.encoder_action_dim, 2),
        }
    }

    /// The shapes of the state, the noise and the actions.
    fn shapes(&self) -> [[usize; 3]; 3] {
        let (config, batch) = (self.head.config(), self.context.batch());
        [
            [batch, config.num_states, config.state_dim],
            [batch, config.action_horizon, config.encoder_action_dim],
            [batch, config.action_horizon, config.action_dim],
        ]
    }

    /// A chunk of actions for each observation.
    pub fn sample(&self, sampling: &Sampling<'_>) -> Result<Vec<f32>> {
        let [state, noise, actions] = self.shapes();
        let mut out = vec![0.0; actions.iter().product()];
        self.head.sample(
            &self.context,
            Array::new(&self.state, &state)?,
            Array::new(&self.embodiment_ids, &state[..1])?,
            Array::new(&self.noise, &noise)?,
            sampling,
            ArrayMut::new(&mut out, &actions)?,
        )?;
        Ok(out)
    }

    /// `count` chunks for each observation, all from the same noise.
    pub fn sample_repeatedly(&self, count: usize, sampling: &Sampling<'_>) -> Result<Vec<f32>> {
        let [state, [batch, horizon, width], [_, _, action_dim]] = self.shapes();
        let chunks = self.noise.chunks(horizon * width);
        let noise: Vec<f32> = chunks.flat_map(|chunk| chunk.repeat(count)).collect();
        let mut out = vec![0.0; batch * count * horizon * action_dim];
        self.head.sample(
            &self.context,
            Array::new(&self.state, &state)?,
            Array::new(&self.embodiment_ids, &state[..1])?,
            Array::new(&noise, &[batch, count, horizon, width])?,
            &Sampling {
                num_samples: Some(count),
                ..*sampling
            },
            ArrayMut::new(&mut out, &[batch, count, horizon, action_dim])?,
        )?;
        Ok(out)
    }

    /// What [`Self::sample`] returns, and what goes on inside.
    pub fn trace(&self, sampling: &Sampling<'_>, options: &TraceOptions) -> Result<Trace> {
        let [state, noise, _] = self.shapes();
        self.head.trace(
            &self.context,
            Array::new(&self.state, &state)?,
            Array::new(&self.embodiment_ids, &state[..1])?,
            Array::new(&self.noise, &noise)?,
            sampling,
            options,
        )
    }

    /// The velocity of the noise at a timestep.
    pub fn velocity(&self, timestep: i64, interventions: &[Intervention]) -> Result<Vec<f32>> {
        let [state, noise, actions] = self.shapes();
        let (mut out, timestep) = (vec![0.0; actions.iter().product()], [timestep]);
        let noisy = NoisyActions {
            actions: Array::new(&self.noise, &noise)?,
            timestep: Array::new(&timestep, &[])?,
        };
        self.head.velocity(
            &self.context,
            Array::new(&self.state, &state)?,
            Array::new(&self.embodiment_ids, &state[..1])?,
            noisy,
            interventions,
            ArrayMut::new(&mut out, &actions)?,
        )?;
        Ok(out)
    }

    /// The noise, `(batch, action_horizon, encoder_action_dim)`.
    pub fn noise(&self) -> &[f32] {
        &self.noise
    }
}
