//! Loads a checkpoint, encodes an observation and samples a chunk of actions.
//!
//! `cargo run --release -p saccade-vla --example sample [CHECKPOINT]`; without an argument, a tiny one of random weights.

use std::path::PathBuf;

use saccade_vla::{ActionHead, Array, ArrayMut, Features, LoadOptions, Result, Sampling};

/// Vision-language tokens of the observation.
const NUM_VL_TOKENS: usize = 60;

/// Numbers between -1 and 1 that look random and are the same at every run.
fn numbers(len: usize, seed: u32) -> Vec<f32> {
    let mut state = seed;
    let mut next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 23) as f32 - 1.0
    };
    (0..len).map(|_| next()).collect()
}

fn main() -> Result<()> {
    let tiny = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/tiny");
    let checkpoint = std::env::args_os().nth(1);
    let checkpoint = checkpoint.map_or_else(|| tiny.into(), PathBuf::from);
    let head = ActionHead::load(&checkpoint, &LoadOptions::default())?;
    let config = head.config();
    println!(
        "GR00T {}: {} blocks of width {}, {} on {} threads, {:.1} MB",
        config.version,
        config.num_layers,
        config.width,
        head.engine().isa,
        head.engine().threads,
        head.nbytes() as f64 / 1e6
    );

    // An observation is encoded once. Real features come from the vision-language backbone, a real state from the robot.
    let shape = [1, NUM_VL_TOKENS, config.context_dim];
    let features = numbers(shape.iter().product(), 1);
    // Every third token is an image's: heads whose blocks alternate between text and images need to know.
    let image_mask: Vec<bool> = (0..NUM_VL_TOKENS).map(|token| token % 3 == 0).collect();
    let features = Features {
        image_mask: Some(Array::new(&image_mask, &[1, NUM_VL_TOKENS])?),
        ..Features::new(Array::new(&features, &shape)?)
    };
    let context = head.encode(&features)?;

    // Chunks are sampled from it as often as wanted.
    let state_shape = [1, config.num_states, config.state_dim];
    let state = vec![0.0; state_shape.iter().product()];
    let noise_shape = [1, config.action_horizon, config.encoder_action_dim];
    let noise = numbers(noise_shape.iter().product(), 2);
    let shape = [1, config.action_horizon, config.action_dim];
    let mut actions = vec![0.0; shape.iter().product()];
    head.sample(
        &context,
        Array::new(&state, &state_shape)?,
        Array::new(&[head.embodiment_ids()[0] as i64], &[1])?,
        Array::new(&noise, &noise_shape)?,
        &Sampling {
            num_steps: Some(4),
            ..Sampling::default()
        },
        ArrayMut::new(&mut actions, &shape)?,
    )?;
    for (step, action) in actions.chunks(config.action_dim).enumerate() {
        let shown: Vec<String> = action.iter().map(|value| format!("{value:7.3}")).collect();
        println!("action {step:2}: {}", shown.join(" "));
    }
    Ok(())
}
