//! Savings of the head change no bit, and layers that it merges are the released ones.

mod common;

use common::{HEADS, Inputs, Tensors, data, head_of, metadata, released};
use saccade_vla::{Group, Keep, Sampling, TraceOptions, files::Checkpoint};

/// A trace runs all rows in the last block, a call without one those of the actions.
#[test]
fn the_last_block_on_action_rows_only_changes_no_bit() {
    for file in HEADS {
        let head = released(file, 2);
        let inputs = Inputs::new(&head, &[0, 1, 0], 9);
        for num_steps in [Some(1), Some(4), Some(7)] {
            let sampling = Sampling {
                num_steps,
                ..Sampling::default()
            };
            let all = inputs.trace(&sampling, &TraceOptions::default()).unwrap();
            let needed = inputs.sample(&sampling).unwrap();
            assert_eq!(needed, all.actions.data(), "{file}, {num_steps:?}");
        }
    }
}

#[test]
fn cached_modulations_and_time_biases_change_no_bit() {
    let (head, fresh) = (released(HEADS[0], 2), released(HEADS[0], 2));
    let inputs = Inputs::new(&head, &[0, 1], 9);
    let first = inputs.velocity(250, &[]).unwrap();
    // More than are cached.
    for timestep in 0..266 {
        inputs.velocity(timestep, &[]).unwrap();
    }
    assert_eq!(
        inputs.velocity(250, &[]).unwrap(),
        first,
        "pushed out and computed again"
    );
    let inputs = Inputs::new(&fresh, &[0, 1], 9);
    assert_eq!(inputs.velocity(250, &[]).unwrap(), first, "never kept before");
}

/// The action encoder as the released code has it: `W3(silu(W2([W1(x); tau])))`, in float64.
///
/// The rows after a block that adds nothing are the encoded actions, and with decoders that return zeros the actions
/// stay the noise: both are made of a released head by setting tensors to zero.
#[test]
fn the_action_encoder_taken_apart_is_the_plain_one() {
    const PREFIX: &str = "action_head.";
    let path = data(HEADS[0]);
    let checkpoint = Checkpoint::open(&path).unwrap();
    let is_zero = |name: &str| {
        ["attn1.to_out.0", "ff.net.2"]
            .iter()
            .any(|layer| name.starts_with(&format!("model.transformer_blocks.0.{layer}.")))
            || name.starts_with("action_decoder.layer2.")
    };
    let tensors = checkpoint.names().filter_map(|full| {
        let name = full.strip_prefix(PREFIX)?.to_owned();
        let mut values = checkpoint.read_f32(full).unwrap();
        if is_zero(&name) {
            values.fill(0.0);
        }
        Some((name, (checkpoint.shape(full)?.to_vec(), values)))
    });
    let tensors: Tensors = tensors.collect();
    let head = head_of(&tensors, &metadata(&path, "config"));
    let (config, id) = (head.config(), 1);
    let width = config.width;
    let slice = |name: &str| {
        let values = &tensors[&format!("action_encoder.{name}")].1;
        let len = values.len() / config.num_embodiments;
        let slice = values[id * len..(id + 1) * len].iter().copied();
        slice.map(f64::from).collect::<Vec<_>>()
    };
    let linear = |layer: &str, x: &[f64]| {
        let (weight, mut out) = (slice(&format!("{layer}.W")), slice(&format!("{layer}.b")));
        let outputs = out.len();
        for (k, x) in x.iter().enumerate() {
            for (out, w) in out.iter_mut().zip(&weight[k * outputs..]) {
                *out += x * w;
            }
        }
        out
    };
    let inputs = Inputs::new(&head, &[id as i64], 9);
    let sampling = Sampling {
        num_steps: Some(4),
        ..Sampling::default()
    };
    // Step 1 of 4 is at timestep 250.
    let options = TraceOptions {
        record: Keep {
            hidden: true,
            ..Keep::default()
        },
        blocks: Some(vec![0]),
        steps: Some(vec![1]),
        ..TraceOptions::default()
    };
    let trace = inputs.trace(&sampling, &options).unwrap();
    let rows = &trace.recorded.hidden[&(1, 0)];
    let encoded = &rows.data()[trace.groups.range(Group::Action).start * width..];

    // Frequencies and angles are float32.
    let half = width / 2;
    let angle = |i: usize| {
        let frequency = f64::from(-(i as f32) * (10_000_f64.ln() as f32 / half as f32)).exp() as f32;
        f64::from(250.0 * frequency)
    };
    let tau: Vec<f64> = (0..half)
        .map(|i| angle(i).sin())
        .chain((0..half).map(|i| angle(i).cos()))
        .collect();
    let positions = &tensors["position_embedding.weight"].1;
    let actions = inputs.noise().chunks(config.encoder_action_dim);
    assert_eq!(actions.len(), config.action_horizon);
    for (row, action) in actions.enumerate() {
        let action: Vec<f64> = action.iter().copied().map(f64::from).collect();
        let both = [linear("W1", &action), tau.clone()].concat();
        let silu = |x: f64| x / (1.0 + (-x).exp());
        let hidden: Vec<f64> = linear("W2", &both).into_iter().map(silu).collect();
        for (column, expected) in linear("W3", &hidden).into_iter().enumerate() {
            let index = row * width + column;
            let expected = expected + f64::from(positions[index]);
            let error = (f64::from(encoded[index]) - expected).abs();
            assert!(
                error <= 2e-6 * expected.abs().max(1.0),
                "row {row}, column {column}: {error}"
            );
        }
    }
}
