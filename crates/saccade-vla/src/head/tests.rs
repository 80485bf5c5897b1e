//! The head against itself and against float64, from inside.

use std::path::Path;

use saccade_vla_kernels::Rows;

use super::action_encoder::CACHED_TIME_BIASES;
use super::action_head::ActionHead;
use super::context::Context;
use super::dit::{ActiveRows, Pass};
use super::encode::Features;
use super::load::LoadOptions;
use super::workspace::Workspace;
use crate::array::Array;
use crate::inspect::changes::Changes;
use crate::inspect::trace::Recorded;
use crate::sampling::timestep_embedding::action_encoder_embedding;

/// A released head, with the config in the file's metadata.
fn released(name: &str) -> ActionHead {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../tests/data")
        .join(name);
    let options = LoadOptions {
        config: Some(config_of(&path)),
        num_threads: Some(2),
        ..LoadOptions::default()
    };
    ActionHead::load(&path, &options).unwrap()
}

/// The config in the metadata of a file.
fn config_of(path: &Path) -> String {
    let bytes = std::fs::read(path).unwrap();
    let size = usize::try_from(u64::from_le_bytes(bytes[..8].try_into().unwrap())).unwrap();
    let header: serde_json::Value = serde_json::from_slice(&bytes[8..8 + size]).unwrap();
    header["__metadata__"]["config"].as_str().unwrap().to_owned()
}

/// Numbers that look random and are the same everywhere.
fn numbers(len: usize, seed: u32) -> Vec<f32> {
    let mut state = seed.wrapping_mul(2_654_435_761).wrapping_add(12345);
    (0..len)
        .map(|_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 23) as f32 - 1.0
        })
        .collect()
}

fn context(head: &ActionHead, batch: usize) -> Context {
    let shape = [batch, 9, head.config.context_dim];
    let features = numbers(shape.iter().product(), 1);
    let image_mask: Vec<_> = (0..batch * 9).map(|token| token % 3 == 1).collect();
    let features = Features::new(Array::new(&features, &shape).unwrap());
    let image_mask = Some(Array::new(&image_mask, &shape[..2]).unwrap());
    head.encode(&Features {
        image_mask,
        ..features
    })
    .unwrap()
}

/// One velocity with all rows, or only the needed ones, in the last block.
fn velocity(head: &ActionHead, context: &Context, timestep: usize, rows: ActiveRows) -> Vec<f32> {
    let mut workspace = Workspace::default();
    let config = &head.config;
    workspace
        .embodiment_ids
        .extend((0..context.batch).map(|observation| observation % 2));
    noisy_actions(head, context.batch, &mut workspace);
    let state = numbers(context.batch * config.num_states * config.state_dim, 3);
    head.encode_state(&state, &mut workspace).unwrap();
    let changes = Changes::new(&[], head.extent(&[], context, 1).unwrap()).unwrap();
    let pass = Pass {
        context,
        samples: 1,
        changes: &changes,
        step: 0,
        rows,
    };
    head.evaluate(&pass, |_| timestep, &mut Recorded::default(), &mut workspace)
        .unwrap();
    workspace.velocity.as_slice().to_vec()
}

/// Writes noisy actions of one chunk for each observation to `workspace.x`.
fn noisy_actions(head: &ActionHead, batch: usize, workspace: &mut Workspace) {
    let width = head.config.encoder_action_dim;
    let actions = numbers(batch * head.config.action_horizon * width, 2);
    let mut x = workspace.x.rows(actions.len() / width, width).unwrap();
    x.copy_from(Rows::new(&actions, width));
}

const FILES: [&str; 5] = [
    "n15_tiny.safetensors",
    "n15_single_view.safetensors",
    "n15_bf16.safetensors",
    "n17_tiny.safetensors",
    "fork_two_decoders.safetensors",
];

#[test]
fn the_last_block_on_action_rows_only_changes_no_bit() {
    for file in FILES {
        let head = released(file);
        let context = context(&head, 3);
        for timestep in [0, 499, 999] {
            let needed = velocity(&head, &context, timestep, ActiveRows::Needed);
            let all = velocity(&head, &context, timestep, ActiveRows::All);
            assert_eq!(needed, all, "{file} at {timestep}");
        }
    }
}

#[test]
fn cached_modulations_and_time_biases_change_no_bit() {
    let (head, fresh) = (released(FILES[0]), released(FILES[0]));
    let kept = context(&head, 2);
    let first = velocity(&head, &kept, 250, ActiveRows::Needed);
    for timestep in 0..CACHED_TIME_BIASES + 10 {
        velocity(&head, &kept, timestep, ActiveRows::Needed);
    }
    assert_eq!(
        velocity(&head, &kept, 250, ActiveRows::Needed),
        first,
        "pushed out and computed again"
    );
    let kept = context(&fresh, 2);
    assert_eq!(
        velocity(&fresh, &kept, 250, ActiveRows::Needed),
        first,
        "never kept before"
    );
}

/// The action encoder as the released code has it: `W3(silu(W2([W1(x); tau])))`, in float64.
#[test]
fn the_action_encoder_taken_apart_is_the_plain_one() {
    let name = FILES[0];
    let head = released(name);
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../tests/data")
        .join(name);
    let checkpoint = crate::Checkpoint::open(&path).unwrap();
    let (width, id, timestep) = (head.config.width, 1, 250);
    let slice = |name: &str| {
        let tensor = checkpoint
            .read_slices(&format!("action_head.action_encoder.{name}"), id..id + 1)
            .unwrap();
        tensor
            .into_f32()
            .unwrap()
            .into_iter()
            .map(f64::from)
            .collect::<Vec<_>>()
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
    let mut workspace = Workspace::default();
    workspace.embodiment_ids.push(id);
    noisy_actions(&head, 1, &mut workspace);
    head.encode_actions(|_| timestep, &mut workspace).unwrap();

    let mut tau = vec![0.0; width];
    action_encoder_embedding(timestep, &mut tau);
    let table = checkpoint
        .read_f32("action_head.position_embedding.weight")
        .unwrap();
    let positions = &table[..head.config.action_horizon * width];
    for (row, action) in workspace.x.as_rows().iter().enumerate() {
        let action: Vec<f64> = action.iter().copied().map(f64::from).collect();
        let mut both = linear("W1", &action);
        both.extend(tau.iter().copied().map(f64::from));
        let hidden: Vec<f64> = linear("W2", &both)
            .into_iter()
            .map(|x| x / (1.0 + (-x).exp()))
            .collect();
        for (column, expected) in linear("W3", &hidden).into_iter().enumerate() {
            let index = row * width + column;
            let expected = expected + f64::from(positions[index]);
            let error = (f64::from(workspace.action.as_slice()[index]) - expected).abs();
            assert!(
                error <= 2e-6 * expected.abs().max(1.0),
                "row {row}, column {column}: {error}"
            );
        }
    }
}
