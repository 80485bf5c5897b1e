//! Records what the future tokens attend to, then removes what they attend to most and shows how the actions change.
//!
//! `cargo run --release -p saccade-vla --example look_inside [CHECKPOINT]`; without an argument, a tiny one of random weights.

use std::path::PathBuf;

use saccade_vla::{
    ActionHead, Array, Features, Group, Intervention, Keep, LoadOptions, Result, Sampling, Tokens, Trace,
    TraceOptions,
};

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

/// The mean attention of the future rows on each vision-language token, over heads, blocks and steps of one observation.
fn attention_on_vl(trace: &Trace, num_layers: usize, is_cross: impl Fn(usize) -> bool) -> Vec<f64> {
    let (future, mut sums) = (trace.groups.range(Group::Future), vec![0.0; trace.groups.vl]);
    let mut rows = 0.0;
    for ((_, block), attention) in &trace.recorded.attention {
        assert!(*block < num_layers);
        if !is_cross(*block) {
            continue;
        }
        let &[_, heads, queries, keys] = attention.shape() else {
            unreachable!("(batch, heads, queries, keys)")
        };
        for head in 0..heads {
            for query in future.clone() {
                let row = &attention.data()[(head * queries + query) * keys..][..keys];
                sums.iter_mut()
                    .zip(row)
                    .for_each(|(sum, weight)| *sum += f64::from(*weight));
                rows += 1.0;
            }
        }
    }
    sums.into_iter().map(|sum| sum / rows).collect()
}

fn main() -> Result<()> {
    let tiny = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/tiny");
    let checkpoint = std::env::args_os().nth(1);
    let checkpoint = checkpoint.map_or_else(|| tiny.into(), PathBuf::from);
    let head = ActionHead::load(&checkpoint, &LoadOptions::default())?;
    let config = head.config();

    let shape = [1, NUM_VL_TOKENS, config.context_dim];
    let features = numbers(shape.iter().product(), 1);
    let image_mask: Vec<bool> = (0..NUM_VL_TOKENS).map(|token| token % 3 == 0).collect();
    let features = Features {
        image_mask: Some(Array::new(&image_mask, &[1, NUM_VL_TOKENS])?),
        ..Features::new(Array::new(&features, &shape)?)
    };
    let context = head.encode(&features)?;

    let state_shape = [1, config.num_states, config.state_dim];
    let state = vec![0.0; state_shape.iter().product()];
    let noise_shape = [1, config.action_horizon, config.encoder_action_dim];
    let noise = numbers(noise_shape.iter().product(), 2);
    let embodiment = [head.embodiment_ids()[0] as i64];
    let trace = |interventions: &[Intervention]| {
        head.trace(
            &context,
            Array::new(&state, &state_shape)?,
            Array::new(&embodiment, &[1])?,
            Array::new(&noise, &noise_shape)?,
            &Sampling {
                interventions,
                ..Sampling::default()
            },
            &TraceOptions {
                record: Keep {
                    attention: true,
                    ..Keep::default()
                },
                ..TraceOptions::default()
            },
        )
    };

    let plain = trace(&[])?;
    let attention = attention_on_vl(&plain, config.num_layers, |block| config.is_cross(block));
    let mut order: Vec<usize> = (0..attention.len()).collect();
    order.sort_by(|a, b| attention[*b].total_cmp(&attention[*a]));
    println!("the future tokens attend most to:");
    for token in &order[..5] {
        println!(
            "  token {token:2}: {:.1} % of their attention",
            100.0 * attention[*token]
        );
    }

    let future = Tokens {
        group: Group::Future,
        indices: None,
    };
    let most = Tokens {
        group: Group::Vl,
        indices: Some(order[..5].to_vec()),
    };
    let cut = Intervention {
        cut: vec![(future, most)],
        ..Intervention::default()
    };
    let without = trace(&[cut])?;
    let (before, after) = (plain.actions.data(), without.actions.data());
    let squares: f64 = before
        .iter()
        .zip(after)
        .map(|(before, after)| f64::from(after - before).powi(2))
        .sum();
    println!(
        "without these five tokens the actions change by {:.4} (root mean square)",
        (squares / before.len() as f64).sqrt()
    );
    Ok(())
}
