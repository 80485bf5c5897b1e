//! A checkpoint whose weights are rounded for what its layers are given, from the watch to the file.

mod common;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use saccade_vla::files::{Checkpoint, Elements};
use saccade_vla::{
    ActionHead, Array, ErrorKind, LinearWatch, LoadOptions, Precision, RewriteOptions, RoundedLayer,
    Sampling, WatchedLinear, gptq, quantize, quantized_weights, round_layer,
};

fn source() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/tiny")
}

/// A new directory of this test.
fn folder(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("saccade-calibrated-{name}-{}", std::process::id()));
    std::fs::create_dir_all(&path).unwrap();
    path
}

/// The head alone, whose blocks are quantised.
fn head_only() -> RewriteOptions {
    RewriteOptions {
        head_only: true,
        ..RewriteOptions::default()
    }
}

/// The layers of a head, with what those that begin with `wanted` are given.
fn watched(wanted: BTreeSet<String>) -> Vec<WatchedLinear> {
    let options = LoadOptions {
        num_threads: Some(1),
        ..LoadOptions::default()
    };
    let head = ActionHead::load(&source(), &options).unwrap();
    let watch = LinearWatch::start(wanted).unwrap();
    let id = i64::try_from(head.embodiment_ids()[0]).unwrap();
    common::Inputs::new(&head, &[id], 9)
        .sample(&Sampling::default())
        .unwrap();
    watch.finish().unwrap()
}

#[test]
fn weights_of_layers_are_those_of_the_checkpoint() {
    let folder = folder("whole");
    let names = quantized_weights(&source(), &folder.join("out"), &head_only()).unwrap();
    assert_eq!(names.backbone_prefix, None);
    assert!(!folder.join("out").exists());
    let full = |name: &String| format!("{}{name}", names.head_prefix);
    let first = watched(BTreeSet::new())
        .into_iter()
        .map(|layer| layer.weights[0].clone());
    let wanted: BTreeSet<_> = first.filter(|first| names.names.contains(&full(first))).collect();
    let checkpoint = Checkpoint::open(&source()).unwrap();
    let (mut rounded, mut seen) = (Vec::new(), BTreeSet::new());
    for (index, layer) in watched(wanted).into_iter().enumerate() {
        let Some(gram) = layer.gram else { continue };
        let weights: Vec<_> = layer.weights.iter().map(full).collect();
        let out = folder.join(index.to_string());
        let errors = round_layer(&checkpoint, &weights, &gram, &out, 2).unwrap();
        assert!(
            errors.rounded < errors.plain && errors.plain < 0.1 * errors.outputs,
            "{errors:?}"
        );
        let found = RoundedLayer::open(&out).unwrap();
        assert_eq!(found.errors, errors);
        let stored: BTreeSet<_> = found.weights().map(str::to_owned).collect();
        assert_eq!(stored, weights.iter().cloned().collect());

        // Each weight alone gives the same as all of the layer together.
        let layer = Checkpoint::open(&out).unwrap();
        for name in &weights {
            let Elements::Int4 { values, scales } = layer.read(name).unwrap() else {
                panic!("{name} is stored in four bits");
            };
            let weight = checkpoint.read_f32(name).unwrap();
            let shape = checkpoint.shape(name).unwrap();
            let alone = gptq(Array::new(&weight, shape).unwrap(), &scales, &gram, 1).unwrap();
            let halves = values
                .iter()
                .flat_map(|&pair| [pair << 4, pair & 0xf0])
                .map(|half| half.cast_signed() >> 4);
            // Rows are whole bytes: after an odd number of inputs is a half that counts for nothing.
            let width = shape[1].next_multiple_of(2);
            let kept: Vec<i8> = halves
                .enumerate()
                .filter(|(place, _)| place % width < shape[1])
                .map(|(_, value)| value)
                .collect();
            assert_eq!(kept, alone.values, "{name}");
        }
        seen.extend(weights);
        rounded.push(out);
    }
    assert_eq!(seen, names.names, "every weight belongs to a layer that was run");

    let out = folder.join("out");
    let options = RewriteOptions {
        rounded,
        ..head_only()
    };
    let report = quantize(&source(), &out, Precision::Int4, &options, |_, _| true).unwrap();
    assert_eq!(
        (report.num_calibrated, report.num_quantized),
        (seen.len(), seen.len())
    );
    let plain = folder.join("plain");
    let before = quantize(&source(), &plain, Precision::Int4, &head_only(), |_, _| true).unwrap();
    assert_eq!((before.num_calibrated, before.num_quantized), (0, seen.len()));
    let (written, plain) = (Checkpoint::open(&out).unwrap(), Checkpoint::open(&plain).unwrap());
    let mut differing = 0;
    for name in written.names() {
        let layers = options.rounded.iter().map(|path| Checkpoint::open(path).unwrap());
        let own = layers.into_iter().find(|layer| layer.shape(name).is_some());
        let (found, rounded_plainly) = (written.read(name).unwrap(), plain.read(name).unwrap());
        match own {
            Some(layer) => assert_eq!(found, layer.read(name).unwrap(), "{name}"),
            None => assert_eq!(found, rounded_plainly, "{name}"),
        }
        differing += usize::from(found != rounded_plainly);
    }
    assert!(differing > seen.len() / 2, "{differing} of {}", seen.len());
    let options = LoadOptions {
        precision: Precision::Int4,
        ..LoadOptions::default()
    };
    ActionHead::load(&out, &options).unwrap();
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn what_is_wrong_is_named() {
    let folder = folder("wrong");
    let checkpoint = Checkpoint::open(&source()).unwrap();
    let names = quantized_weights(&source(), &folder.join("out"), &head_only()).unwrap();
    let error = quantized_weights(&source(), &source(), &head_only()).unwrap_err();
    assert!(error.to_string().contains("holds the source"), "{error}");
    let name = names.names.first().unwrap().clone();
    let width = checkpoint.shape(&name).unwrap()[1];
    let gram = saccade_vla::Gram::new(width).unwrap();
    let (layer, again) = (folder.join("layer"), folder.join("again"));
    let round = |names: &[String], gram: &saccade_vla::Gram, out: &Path| {
        round_layer(&checkpoint, names, gram, out, 1)
    };
    round(std::slice::from_ref(&name), &gram, &layer).unwrap();
    round(std::slice::from_ref(&name), &gram, &again).unwrap();

    let error = round(std::slice::from_ref(&name), &gram, &layer).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::Input);
    assert!(error.to_string().contains("layer"), "{error}");
    let narrow = saccade_vla::Gram::new(width + 1).unwrap();
    let error = round(std::slice::from_ref(&name), &narrow, &folder.join("narrow")).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::Shape);
    assert!(
        error
            .to_string()
            .starts_with(&format!("{name}: expected (out_features, {})", width + 1)),
        "{error}"
    );
    let error = round(&["nothing".to_owned()], &gram, &folder.join("nothing")).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::Checkpoint);

    let call = |to: Precision, rounded: &[&Path]| {
        let options = RewriteOptions {
            rounded: rounded.iter().map(|path| path.to_path_buf()).collect(),
            ..head_only()
        };
        let error = quantize(&source(), &folder.join("out"), to, &options, |_, _| true).err();
        assert!(!folder.join("out").exists());
        error.unwrap().to_string()
    };
    assert_eq!(
        call(Precision::Int8, &[&layer]),
        "rounded: expected none with 'int8', since they have four bits, got 1 layers"
    );
    assert_eq!(
        call(Precision::Int4, &[&layer, &again]),
        format!("rounded: expected each weight once, got {name} twice")
    );
    let ordinary = source();
    assert!(call(Precision::Int4, &[&ordinary]).contains("expected a layer that was rounded"));

    // A layer of another checkpoint: a weight that is not quantised here, and one of another shape.
    let other = checkpoint
        .names()
        .find(|other| !names.names.contains(*other) && checkpoint.shape(other).unwrap().len() == 2);
    let other = other.unwrap().to_owned();
    let gram = saccade_vla::Gram::new(checkpoint.shape(&other).unwrap()[1]).unwrap();
    let stray = folder.join("stray");
    round(std::slice::from_ref(&other), &gram, &stray).unwrap();
    assert_eq!(
        call(Precision::Int4, &[&stray]),
        format!("rounded: expected weights that become int4, got {other}")
    );
    std::fs::remove_dir_all(folder).unwrap();
}
