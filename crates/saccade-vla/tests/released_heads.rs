//! Released heads through the public interface.

mod common;

use common::{HEADS, data, metadata, numbers, released};
use saccade_vla::{
    ActionHead, Array, Features, HeadCheckpoint, LoadOptions, Precision, files::Checkpoint, tensor_shapes,
};

#[test]
fn encoding_in_chunks_changes_no_bit() {
    // 200 observations of 9 tokens are more rows than are encoded together.
    let head = released(HEADS[0], 2);
    let width = head.config().context_dim;
    let all = numbers(200 * 9 * width, 1);
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
    for name in HEADS {
        let path = data(name);
        let config = metadata(&path, "config");
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
    for name in HEADS {
        let head = released(name, 2);
        let path = data(name);
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
