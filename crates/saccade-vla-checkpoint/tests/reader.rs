//! Reading: files that change meanwhile, slices, threads, reading ahead, names of wrapped models.

mod common;

use std::fs::File;
use std::io::Write;
use std::ops::Range;
use std::path::Path;

use common::{Temporary, vectors};
use saccade_vla_checkpoint::{Checkpoint, Elements, Wanted, plain_name};

fn two_numbers() -> Temporary {
    vectors(&[("a", &[1.0, 2.0])])
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
        let file = two_numbers();
        let checkpoint = Checkpoint::open(file.path()).unwrap();
        assert!(checkpoint.read("a").is_ok());
        change(file.path()).unwrap();
        let error = checkpoint.read("a").unwrap_err().to_string();
        assert!(error.contains(expected), "{name}: {error}");
    }
}

#[test]
fn a_file_that_is_removed_or_replaced_stays_what_it_was() {
    let (file, other) = (two_numbers(), two_numbers());
    let checkpoint = Checkpoint::open(file.path()).unwrap();
    std::fs::write(other.path(), b"something else").unwrap();
    std::fs::rename(other.path(), file.path()).unwrap();
    assert_eq!(checkpoint.read("a").unwrap(), Elements::F32(vec![1.0, 2.0]));
    std::fs::remove_file(file.path()).unwrap();
    assert_eq!(checkpoint.read("a").unwrap(), Elements::F32(vec![1.0, 2.0]));
}

#[test]
fn slices_are_those_that_are_there() {
    let file = two_numbers();
    let checkpoint = Checkpoint::open(file.path()).unwrap();
    assert_eq!(
        checkpoint.read_slices("a", 1..2).unwrap(),
        Elements::F32(vec![2.0])
    );
    #[allow(clippy::reversed_empty_ranges)]
    for wanted in [0..3, 3..3, 2..1, 0..usize::MAX] {
        assert!(checkpoint.read_slices("a", wanted).is_err());
    }
}

#[test]
fn threads_read_different_tensors_at_once() {
    const NUM_TENSORS: usize = 8;
    const LENGTH: usize = 5000;
    let names: Vec<String> = (0..NUM_TENSORS).map(|index| format!("t{index}")).collect();
    let values: Vec<Vec<f32>> = (0..NUM_TENSORS).map(|index| vec![index as f32; LENGTH]).collect();
    let tensors: Vec<(&str, &[f32])> = names
        .iter()
        .map(|name| &**name)
        .zip(values.iter().map(|v| &**v))
        .collect();
    let file = vectors(&tensors);
    let checkpoint = Checkpoint::open(file.path()).unwrap();
    std::thread::scope(|scope| {
        for (name, values) in tensors {
            let checkpoint = &checkpoint;
            scope.spawn(move || {
                let expected = Elements::F32(values.to_vec());
                for _ in 0..200 {
                    assert!(checkpoint.read(name).unwrap() == expected, "{name}");
                }
            });
        }
    });
}

fn wanted(name: &str, slices: Option<Range<usize>>) -> Wanted {
    Wanted {
        name: name.to_owned(),
        slices,
        is_given_back: true,
    }
}

#[test]
fn tensors_come_in_any_order() {
    let file = vectors(&[("a", &[1.0, 2.0]), ("b", &[3.0])]);
    let checkpoint = Checkpoint::open(file.path()).unwrap();
    let order = vec![wanted("a", None), wanted("b", None), wanted("a", Some(1..2))];
    let expected = |name: &str, slices: &Option<Range<usize>>| match (name, slices) {
        ("b", _) => Elements::F32(vec![3.0]),
        (_, Some(_)) => Elements::F32(vec![2.0]),
        _ => Elements::F32(vec![1.0, 2.0]),
    };
    for asked in [
        vec![0, 1, 2],
        vec![2, 1, 0],
        vec![1],
        vec![0, 0, 1, 1, 2, 2],
        vec![],
    ] {
        checkpoint.read_ahead(order.clone(), |tensors| {
            for index in asked {
                let Wanted { name, slices, .. } = &order[index];
                let read = tensors.take(name, slices.clone()).unwrap();
                assert_eq!(read, expected(name, slices));
                tensors.give_back(read);
            }
        });
    }
    let missing = vec![wanted("c", None)];
    assert!(checkpoint.read_ahead(missing, |tensors| tensors.take("c", None).is_err()));
}

#[test]
fn wrappers_are_left_out() {
    for (name, expected) in [
        ("a.b.weight", "a.b.weight"),
        ("_orig_mod.a.weight", "a.weight"),
        ("backbone._orig_mod.model.weight", "backbone.model.weight"),
        ("module.a.weight", "a.weight"),
        ("module._orig_mod.a.weight", "a.weight"),
        ("_orig_mod.module.a._orig_mod.weight", "a.weight"),
        ("module.module.a", "a"),
        ("_orig_mod.weight", "weight"),
        // Not wrappers.
        ("a.module.weight", "a.module.weight"),
        ("modules.a", "modules.a"),
        ("x_orig_mod.a", "x_orig_mod.a"),
        ("module", "module"),
        ("a._orig_mod", "a._orig_mod"),
        ("", ""),
    ] {
        assert_eq!(plain_name(name), expected);
    }
}
