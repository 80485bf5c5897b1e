//! Released heads through the public interface.

use std::path::{Path, PathBuf};

use saccade_vla::{
    ActionHead, Array, Checkpoint, Features, HeadCheckpoint, LoadOptions, Precision, tensor_shapes,
};

const FILES: [&str; 5] = [
    "n15_tiny.safetensors",
    "n15_single_view.safetensors",
    "n15_bf16.safetensors",
    "n17_tiny.safetensors",
    "fork_two_decoders.safetensors",
];

fn path(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../tests/data")
        .join(name)
}

/// The config in the metadata of a file.
fn config_of(path: &Path) -> String {
    let bytes = std::fs::read(path).unwrap();
    let size = usize::try_from(u64::from_le_bytes(bytes[..8].try_into().unwrap())).unwrap();
    let header: serde_json::Value = serde_json::from_slice(&bytes[8..8 + size]).unwrap();
    header["__metadata__"]["config"].as_str().unwrap().to_owned()
}

fn released(name: &str) -> ActionHead {
    let options = LoadOptions {
        config: Some(config_of(&path(name))),
        num_threads: Some(2),
        ..LoadOptions::default()
    };
    ActionHead::load(&path(name), &options).unwrap()
}

/// Numbers that look random and are the same everywhere.
fn numbers(len: usize) -> Vec<f32> {
    let mut state = 1_u32;
    let mut next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 23) as f32 - 1.0
    };
    (0..len).map(|_| next()).collect()
}

#[test]
fn encoding_in_chunks_changes_no_bit() {
    // 200 observations of 9 tokens are more rows than are encoded together.
    let head = released(FILES[0]);
    let width = head.config().context_dim;
    let all = numbers(200 * 9 * width);
    let many = head
        .encode(&Features::new(Array::new(&all, &[200, 9, width]).unwrap()))
        .unwrap();
    for observation in [0, 113, 199] {
        let one = &all[observation * 9 * width..(observation + 1) * 9 * width];
        let one = head
            .encode(&Features::new(Array::new(one, &[1, 9, width]).unwrap()))
            .unwrap();
        assert_eq!(
            one.vl_embs(),
            &many.vl_embs()[observation * 9 * width..(observation + 1) * 9 * width]
        );
    }
}

/// The planner, the file and the sizer run the same description.
#[test]
fn the_size_is_known_before_loading() {
    for name in FILES {
        let path = path(name);
        let config = config_of(&path);
        let published = HeadCheckpoint::open(&path, Some(&config)).unwrap();
        for precision in [Precision::Float32, Precision::Bfloat16, Precision::Int8] {
            for ids in [vec![1], vec![0, 2]] {
                let options = LoadOptions {
                    config: Some(config.clone()),
                    precision,
                    embodiment_ids: Some(ids.clone()),
                    ..LoadOptions::default()
                };
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
        let path = path(name);
        let checkpoint = Checkpoint::open(&path).unwrap();
        let mut planned: Vec<_> = tensor_shapes(head.config())
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
