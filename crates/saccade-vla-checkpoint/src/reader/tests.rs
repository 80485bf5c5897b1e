//! Files that change while they are read, slices, and threads.

use std::fs::File;
use std::io::Write;
use std::path::PathBuf;

use super::*;

/// Two float32, `a`, in the file `name` of the temporary folder.
fn two_numbers(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("saccade-{}-{name}", std::process::id()));
    let header = r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}}"#;
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.extend(header.as_bytes());
    bytes.extend([1.0f32, 2.0].iter().flat_map(|value| value.to_le_bytes()));
    std::fs::write(&path, bytes).unwrap();
    path
}

#[test]
fn a_file_that_changes_after_it_was_opened_is_an_error() {
    type Change = fn(&Path) -> std::io::Result<()>;
    let changes: [(&str, &str, Change); 4] = [
        ("shrinks", "fill whole buffer", |path| {
            File::options().write(true).open(path)?.set_len(10)
        }),
        ("grows", "changed while it was read", |path| {
            File::options().append(true).open(path)?.write_all(b"more")
        }),
        ("rewritten", "changed while it was read", |path| {
            // The clock of a file moves in steps of some milliseconds.
            std::thread::sleep(std::time::Duration::from_millis(30));
            let length = std::fs::metadata(path)?.len();
            std::fs::write(path, vec![0; length as usize])
        }),
        ("emptied", "fill whole buffer", |path| {
            File::create(path).map(|_| ())
        }),
    ];
    for (name, expected, change) in changes {
        let path = two_numbers(name);
        let checkpoint = Checkpoint::open(&path).unwrap();
        assert!(checkpoint.read("a").is_ok());
        change(&path).unwrap();
        let error = checkpoint.read("a").unwrap_err().to_string();
        assert!(error.contains(expected), "{name}: {error}");
        std::fs::remove_file(&path).unwrap();
    }
}

#[test]
fn a_file_that_is_removed_or_replaced_stays_what_it_was() {
    let path = two_numbers("removed");
    let checkpoint = Checkpoint::open(&path).unwrap();
    let other = two_numbers("other");
    std::fs::write(&other, b"something else").unwrap();
    std::fs::rename(&other, &path).unwrap();
    assert_eq!(checkpoint.read("a").unwrap(), Elements::F32(vec![1.0, 2.0]));
    std::fs::remove_file(&path).unwrap();
    assert_eq!(checkpoint.read("a").unwrap(), Elements::F32(vec![1.0, 2.0]));
}

#[test]
fn slices_are_those_that_are_there() {
    let path = two_numbers("slices");
    let checkpoint = Checkpoint::open(&path).unwrap();
    assert_eq!(
        checkpoint.read_slices("a", 1..2).unwrap(),
        Elements::F32(vec![2.0])
    );
    #[allow(clippy::reversed_empty_ranges)]
    for wanted in [0..3, 3..3, 2..1, 0..usize::MAX] {
        assert!(checkpoint.read_slices("a", wanted).is_err());
    }
    std::fs::remove_file(&path).unwrap();
}

#[test]
fn threads_read_different_tensors_at_once() {
    const NUM_TENSORS: usize = 8;
    const LENGTH: usize = 5000;
    let path = std::env::temp_dir().join(format!("saccade-{}-threads", std::process::id()));
    let mut header = serde_json::Map::new();
    for index in 0..NUM_TENSORS {
        let (start, end) = (4 * LENGTH * index, 4 * LENGTH * (index + 1));
        let info = serde_json::json!({"dtype": "F32", "shape": [LENGTH], "data_offsets": [start, end]});
        header.insert(format!("t{index}"), info);
    }
    let header = serde_json::Value::Object(header).to_string();
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.extend(header.as_bytes());
    for index in 0..NUM_TENSORS {
        bytes.extend((index as f32).to_le_bytes().repeat(LENGTH));
    }
    std::fs::write(&path, bytes).unwrap();
    let checkpoint = Checkpoint::open(&path).unwrap();
    std::thread::scope(|scope| {
        for index in 0..NUM_TENSORS {
            let checkpoint = &checkpoint;
            scope.spawn(move || {
                let expected = Elements::F32(vec![index as f32; LENGTH]);
                for _ in 0..200 {
                    assert!(
                        checkpoint.read(&format!("t{index}")).unwrap() == expected,
                        "t{index}"
                    );
                }
            });
        }
    });
    std::fs::remove_file(&path).unwrap();
}
