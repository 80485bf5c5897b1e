//! Writing: all or nothing, one file or several, writers that compete for a name.

mod common;

use std::collections::BTreeMap;
use std::path::Path;

use common::Temporary;
use saccade_vla_checkpoint::{Checkpoint, CheckpointWriter, Companions, Dtype, Elements, PlannedTensor};

fn planned(name: &str, shape: &[usize]) -> PlannedTensor {
    PlannedTensor {
        name: name.to_owned(),
        dtype: Dtype::F32,
        shape: shape.to_vec(),
    }
}

/// A checkpoint of two tensors, half written, at `out`.
fn half_written(out: &Path, max_shard_bytes: u64, force: bool) -> CheckpointWriter {
    let metadata = BTreeMap::from([("key".to_owned(), "value".to_owned())]);
    let tensors = vec![planned("a", &[2]), planned("b", &[3])];
    let companions = Companions::default();
    let mut writer =
        CheckpointWriter::create(out, tensors, &metadata, &companions, max_shard_bytes, force).unwrap();
    writer.file("config.json", "{}").unwrap();
    for value in [1.0f32, 2.0] {
        writer.tensor("a", &value.to_le_bytes()).unwrap();
    }
    writer
}

fn num_entries(directory: &Temporary) -> usize {
    std::fs::read_dir(directory.path()).unwrap().count()
}

#[test]
fn what_is_written_can_be_read() {
    for (max_shard_bytes, num_files) in [(u64::MAX, 1), (10, 2)] {
        let parent = Temporary::new();
        let out = parent.path().join("out");
        let mut writer = half_written(&out, max_shard_bytes, false);
        writer.zeros("b", 12);
        assert_eq!(writer.finish().unwrap().len(), num_files);
        let checkpoint = Checkpoint::open(&out).unwrap();
        assert_eq!(checkpoint.files().count(), num_files);
        assert_eq!(checkpoint.metadata()["key"], "value");
        assert_eq!(checkpoint.read("a").unwrap(), Elements::F32(vec![1.0, 2.0]));
        assert_eq!(checkpoint.read("b").unwrap(), Elements::F32(vec![0.0; 3]));
        assert_eq!(num_entries(&parent), 1);
    }
}

#[test]
fn long_runs_of_zeros_take_no_space() {
    const LEN: usize = 1 << 20;
    let mut numbers = vec![0_u8; LEN];
    let used = [5, 70_000, 70_001, LEN - 1];
    used.iter().for_each(|&place| numbers[place] = place as u8);
    let parent = Temporary::new();
    let out = parent.path().join("out");
    let tensors = vec![planned("a", &[LEN / 4])];
    let mut writer = CheckpointWriter::create(
        &out,
        tensors,
        &BTreeMap::new(),
        &Companions::default(),
        u64::MAX,
        false,
    )
    .unwrap();
    for piece in numbers.chunks(100_003) {
        writer.tensor("a", piece).unwrap();
    }
    let files = writer.finish().unwrap();
    let path = out.join(&files[0]);
    let written = std::fs::read(&path).unwrap();
    assert!(written.ends_with(&numbers));
    #[cfg(target_os = "linux")]
    {
        use std::os::unix::fs::MetadataExt;
        assert!(512 * std::fs::metadata(path).unwrap().blocks() < LEN as u64 / 2);
    }
}

#[test]
fn of_two_writers_of_a_new_name_the_later_replaces_the_earlier_only_with_force() {
    for force in [false, true] {
        let parent = Temporary::new();
        let out = parent.path().join("out");
        let [mut first, mut second] = [(); 2].map(|()| half_written(&out, u64::MAX, force));
        first.zeros("b", 12);
        first.finish().unwrap();
        second.tensor("b", &[1; 12]).unwrap();
        let b = match second.finish() {
            Ok(_) => Elements::F32(vec![f32::from_le_bytes([1; 4]); 3]),
            Err(error) => {
                assert!(
                    error.to_string().ends_with("exists already; force replaces it"),
                    "{error}"
                );
                Elements::F32(vec![0.0; 3])
            }
        };
        assert_eq!(b != Elements::F32(vec![0.0; 3]), force);
        assert_eq!(Checkpoint::open(&out).unwrap().read("b").unwrap(), b);
        assert_eq!(num_entries(&parent), 1);
    }
}

#[test]
fn what_is_not_finished_leaves_nothing() {
    let parent = Temporary::new();
    drop(half_written(&parent.path().join("out"), u64::MAX, false));
    assert_eq!(num_entries(&parent), 0);
}

#[test]
fn threads_that_write_under_one_name_do_not_meet() {
    let parent = Temporary::new();
    let out = parent.path().join("out");
    std::thread::scope(|scope| {
        for _ in 0..8 {
            scope.spawn(|| {
                for _ in 0..50 {
                    // Each file is new: two writers in one directory, or one that removes another's, would fail.
                    drop(half_written(&out, u64::MAX, false));
                }
            });
        }
    });
    assert_eq!(num_entries(&parent), 0);
}
