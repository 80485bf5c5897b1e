//! Acts from pictures and a sentence: camera frames and words in, a chunk of actions out.
//!
//! `cargo run --release -p saccade-vla --example act [CHECKPOINT]`; without an argument, the policy that comes with
//! saccade. State and actions are the head's: normalised by the robot's statistics.

use std::path::PathBuf;

use saccade_vla::{
    Array, ArrayMut, Frame, LoadOptions, Observation, Policy, PolicyContext, PolicyLoadOptions, Result,
    Sampling,
};

const SIDE: usize = 68;

/// A picture of a table with a red block at this column.
fn picture(column: usize) -> Vec<u8> {
    let pixels = (0..SIDE * SIDE).map(|pixel| (pixel / SIDE, pixel % SIDE));
    let colours = pixels.map(
        |(y, x)| match (30..40).contains(&y) && (column..column + 10).contains(&x) {
            true => [200, 30, 30],
            false => [120, 110, 100],
        },
    );
    colours.flatten().collect()
}

/// Four steps from noise to a chunk of actions, `(action_horizon, action_dim)`, for a robot at rest.
fn act(policy: &Policy, context: &PolicyContext) -> Result<Vec<f32>> {
    let config = policy.head.config();
    let state_shape = [1, config.num_states, config.state_dim];
    let noise_shape = [1, config.action_horizon, config.encoder_action_dim];
    let shape = [1, config.action_horizon, config.action_dim];
    let state = vec![0.0; state_shape.iter().product()];
    // Real noise is drawn from a standard normal distribution.
    let noise: Vec<f32> = (0..noise_shape.iter().product())
        .map(|index| (index as f32).sin())
        .collect();
    let mut actions = vec![0.0; shape.iter().product()];
    policy.sample(
        context,
        Array::new(&state, &state_shape)?,
        Array::new(&[policy.head.embodiment_ids()[0] as i64], &[1])?,
        Array::new(&noise, &noise_shape)?,
        &Sampling {
            num_steps: Some(4),
            ..Sampling::default()
        },
        ArrayMut::new(&mut actions, &shape)?,
    )?;
    Ok(actions)
}

fn main() -> Result<()> {
    let demo = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../python/saccade/checkpoints/demo"
    );
    let checkpoint = std::env::args_os()
        .nth(1)
        .map_or_else(|| demo.into(), PathBuf::from);
    let head = LoadOptions {
        embodiment_ids: Some(vec![0]),
        ..LoadOptions::default()
    };
    let options = PolicyLoadOptions {
        head,
        ..PolicyLoadOptions::default()
    };
    let policy = Policy::load(&checkpoint, &options)?;

    let pictures = [10, 30, 50].map(picture);
    let shape = [SIDE, SIDE, 3];
    let views = ["left", "right", "top"].into_iter().zip(&pictures);
    let views = views.map(|(camera, pixels)| Ok((Some(camera), Frame::U8(Array::new(pixels, &shape)?))));
    let views = views.collect::<Result<Vec<_>>>()?;
    let told = |words| {
        [Observation {
            views: views.clone(),
            instruction: Some(words),
            ..Observation::default()
        }]
    };
    let context = policy.encode(&told("pick up the red block"), None)?;
    println!("{} tokens", context.num_vl_tokens());
    let actions = act(&policy, &context)?;
    for (step, action) in actions.chunks(policy.head.config().action_dim).enumerate() {
        let shown: Vec<String> = action.iter().map(|value| format!("{value:7.3}")).collect();
        println!("action {step:2}: {}", shown.join(" "));
    }

    // With the context before, what did not change is not computed again: here, the frames.
    let next = policy.encode(&told("push the red block"), Some(&context))?;
    let changed = act(&policy, &next)? != actions;
    println!(
        "another sentence, {} actions",
        if changed { "other" } else { "the same" }
    );
    Ok(())
}
