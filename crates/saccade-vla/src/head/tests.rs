//! The head against itself and against float64, from inside.

use std::path::Path;

use super::action_encoder::CACHED_BRACKETS;
use super::action_head::ActionHead;
use super::context::Context;
use super::dit::{ActiveRows, Pass};
use super::encode::Features;
use super::load::LoadOptions;
use super::plan::tensor_shapes;
use super::workspace::Workspace;
use crate::alloc::sized;
use crate::array::Array;
use crate::inspect::changes::Changes;
use crate::inspect::trace::Recorded;
use crate::precision::Precision;
use crate::recognise::HeadCheckpoint;
use crate::sampling::timestep_embedding::action_encoder_embedding;

/// A released head, with the config in the file's metadata.
fn released(name: &str) -> ActionHead {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../tests/data")
        .join(name);
    let options = LoadOptions::default()
        .with_config(config_of(&path))
        .with_num_threads(2);
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
    head.encode(&features.with_image_mask(Array::new(&image_mask, &shape[..2]).unwrap()))
        .unwrap()
}

/// One velocity with all rows, or only the needed ones, in the last block.
fn velocity(head: &ActionHead, context: &Context, timestep: usize, rows: ActiveRows) -> Vec<f32> {
    let mut workspace = Workspace::new();
    let config = &head.config;
    workspace
        .embodiment_ids
        .extend((0..context.batch).map(|element| element % 2));
    let actions = numbers(
        context.batch * config.action_horizon * config.encoder_action_dim,
        2,
    );
    sized(&mut workspace.x, actions.len())
        .unwrap()
        .copy_from_slice(&actions);
    let times = &mut workspace.dit.times;
    times.resize(
        context.batch,
        head.layers.dit.time(head.engine, timestep).unwrap(),
    );
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
    head.step_velocity(&pass, |_| timestep, &mut Recorded::default(), &mut workspace)
        .unwrap();
    workspace.velocity.to_vec()
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
fn kept_modulations_and_brackets_change_no_bit() {
    let (head, fresh) = (released(FILES[0]), released(FILES[0]));
    let kept = context(&head, 2);
    let first = velocity(&head, &kept, 250, ActiveRows::Needed);
    for timestep in 0..CACHED_BRACKETS + 10 {
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
    let mut workspace = Workspace::new();
    workspace.embodiment_ids.push(id);
    let actions = numbers(head.config.action_horizon * head.config.encoder_action_dim, 2);
    sized(&mut workspace.x, actions.len())
        .unwrap()
        .copy_from_slice(&actions);
    head.encode_actions(|_| timestep, &mut workspace).unwrap();

    let mut tau = vec![0.0; width];
    action_encoder_embedding(timestep, &mut tau);
    let table = checkpoint
        .read_f32("action_head.position_embedding.weight")
        .unwrap();
    let positions = &table[..head.config.action_horizon * width];
    let actions = workspace.x.chunks_exact(head.config.encoder_action_dim);
    for (row, action) in actions.enumerate() {
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
            let error = (f64::from(workspace.encoded[index]) - expected).abs();
            assert!(
                error <= 2e-6 * expected.abs().max(1.0),
                "row {row}, column {column}: {error}"
            );
        }
    }
}

#[test]
fn encoding_in_chunks_changes_no_bit() {
    // 200 observations of 9 tokens are more rows than are encoded together.
    let head = released(FILES[0]);
    let many = context(&head, 200);
    let width = head.config.context_dim;
    for element in [0, 113, 199] {
        let features = numbers(200 * 9 * width, 1);
        let one = &features[element * 9 * width..(element + 1) * 9 * width];
        let one = head
            .encode(&Features::new(Array::new(one, &[1, 9, width]).unwrap()))
            .unwrap();
        assert_eq!(
            one.vl_embs(),
            &many.vl_embs()[element * 9 * width..(element + 1) * 9 * width]
        );
    }
}

/// The planner, the file and the sizer run the same description.
#[test]
fn the_size_is_known_before_loading() {
    for name in FILES {
        let path = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../tests/data")
            .join(name);
        let config = config_of(&path);
        let published = HeadCheckpoint::open(&path, Some(&config)).unwrap();
        for precision in [Precision::Float32, Precision::Bfloat16, Precision::Int8] {
            for ids in [vec![1], vec![0, 2]] {
                let options = LoadOptions::default()
                    .with_config(config.clone())
                    .with_precision(precision)
                    .with_embodiment_ids(ids.clone());
                let head = ActionHead::load(&path, &options).unwrap();
                let expected = published.nbytes(precision, ids.len()).unwrap();
                assert_eq!(head.nbytes(), expected, "{name}, {precision}");
            }
        }
    }
}

/// Every tensor of a released file is one that the description asks for, and the other way round.
#[test]
fn the_plan_has_the_tensors_of_the_released_files() {
    for name in FILES {
        let head = released(name);
        let path = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../tests/data")
            .join(name);
        let checkpoint = crate::Checkpoint::open(&path).unwrap();
        let mut planned: Vec<_> = tensor_shapes(&head.config)
            .unwrap()
            .into_iter()
            .map(|(tensor, _)| format!("action_head.{tensor}"))
            .collect();
        planned.sort();
        let is_unused = |tensor: &str| tensor.contains("task_log_sigma") || tensor.contains("mask_token");
        let stored: Vec<_> = checkpoint
            .names()
            .filter(|tensor| tensor.starts_with("action_head.") && !is_unused(tensor))
            .collect();
        assert_eq!(planned, stored, "{name}");
    }
}
