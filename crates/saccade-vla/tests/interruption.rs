//! Calls that compute little or nothing stop too when they are asked to, and leave nothing behind.

mod common;

use std::path::PathBuf;
use std::time::Duration;

use saccade_vla::{
    ActionHead, ConvertOptions, Error, HeadConfig, LoadOptions, Precision, ResizeOptions, Result,
    RewriteOptions, convert, interruptible, merge_future_tokens, quantize, resize, tensor_shapes,
};

/// A released head and its config, which is in the file's metadata.
fn source() -> (PathBuf, String) {
    let path = common::data("n15_tiny.safetensors");
    let config = common::metadata(&path, "config");
    (path, config)
}

/// Whether `work` ends as interrupted if it is asked to stop from its beginning on.
fn stops<R>(work: impl FnOnce() -> Result<R>) -> bool {
    let stopped = interruptible(&|| true, || {
        // The question is asked every 20 ms or so.
        std::thread::sleep(Duration::from_millis(30));
        work()
    });
    matches!(stopped, Err(Error::Interrupted))
}

#[test]
fn planning_stops_without_a_panic() {
    let (path, text) = source();
    let config = HeadConfig::from_json(&text).unwrap();
    assert!(!tensor_shapes(&config).unwrap().is_empty());
    assert!(stops(|| tensor_shapes(&config)));
    let options = LoadOptions {
        config: Some(text),
        ..LoadOptions::default()
    };
    assert!(stops(|| ActionHead::load(&path, &options)));
}

/// Asked to stop once the work has come as far as writing tensors.
#[test]
fn rewriting_stops_within_a_tensor_and_writes_nothing() {
    let (path, text) = source();
    let parent = std::env::temp_dir().join(format!("saccade-interruption-{}", std::process::id()));
    std::fs::create_dir_all(&parent).unwrap();
    let out = parent.join("out");
    let rewrite = RewriteOptions {
        config: Some(text),
        ..RewriteOptions::default()
    };
    let convert_options = ConvertOptions {
        rewrite: rewrite.clone(),
        ..ConvertOptions::default()
    };
    let resize_options = ResizeOptions::new(rewrite.clone(), 40);
    type Rewrite<'a> = &'a dyn Fn(&mut dyn FnMut()) -> Result<()>;
    let rewrites: [Rewrite<'_>; 4] = [
        &|after| convert(&path, &out, &convert_options, |_, _| (after(), true).1).map(drop),
        &|after| quantize(&path, &out, Precision::Int8, &rewrite, |_, _| (after(), true).1).map(drop),
        &|after| quantize(&path, &out, Precision::Int4, &rewrite, |_, _| (after(), true).1).map(drop),
        &|after| resize(&path, &out, &resize_options, |_, _| (after(), true).1).map(drop),
    ];
    for rewrite in rewrites {
        let tensors = std::cell::Cell::new(0);
        let after = &mut || {
            tensors.set(tensors.get() + 1);
            std::thread::sleep(Duration::from_millis(30));
        };
        let stopped = interruptible(&|| tensors.get() > 0, || rewrite(after));
        assert!(matches!(stopped, Err(Error::Interrupted)));
        assert_eq!(tensors.get(), 1, "no other tensor was written");
        assert_eq!(std::fs::read_dir(&parent).unwrap().count(), 0);
    }
    std::fs::remove_dir_all(parent).unwrap();
}

#[test]
fn merging_stops() {
    let tokens: Vec<f32> = (0..64).map(|index| (index * index % 17) as f32).collect();
    assert!(merge_future_tokens(&tokens, 4, 3, None).is_ok());
    assert!(stops(|| merge_future_tokens(&tokens, 4, 3, None)));
}
