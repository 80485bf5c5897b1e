//! Views of frames, against the steps between in the released processors. `tests/processor` compares the pixels of all of
//! them with those of the released ones.

use std::path::{Path, PathBuf};

use saccade_vla::files::Checkpoint;
use saccade_vla::{
    Array, Frame, Preprocessing, Processor, ProcessorOptions, Tokenizer, TokenizerFiles, Version, View,
};

/// Frames that are not changed before they are fitted to patches.
const AS_IT_IS: &str = r#"{"shortest_image_edge": null, "crop_fraction": 1.0, "min_pixels": 4096}"#;

fn data(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../tests/data/backbone")
        .join(file)
}

fn processor(version: Version, preprocessing: Preprocessing, options: &str) -> Processor {
    let tokenizer = Tokenizer::read(&TokenizerFiles::Json(data("tiny_tokenizer.json"))).unwrap();
    let options = ProcessorOptions {
        preprocessing: Some(preprocessing),
        options: Some(options),
        ..ProcessorOptions::default()
    };
    Processor::new(version, tokenizer, &options).unwrap()
}

fn view(processor: &Processor, pixels: &[u8], shape: &[usize]) -> View {
    processor
        .view(Frame::U8(Array::new(pixels, shape).unwrap()))
        .unwrap()
}

#[test]
fn frames_before_the_last_resize() {
    let checkpoint = Checkpoint::open(&data("image_n17.safetensors")).unwrap();
    // The view of a `(height, width, 3)` array of bytes of the fixture.
    let view_of = |processor: &Processor, name: &str| {
        let mut pixels = Vec::new();
        let read = checkpoint.read_bytes(name, |piece| {
            pixels.extend_from_slice(piece);
            Ok::<_, saccade_vla::files::Error>(())
        });
        read.unwrap();
        view(processor, &pixels, checkpoint.shape(name).unwrap())
    };
    let isaac = r#"{"shortest_image_edge": 64, "crop_fraction": 0.95, "min_pixels": 4096}"#;
    let lerobot = r#"{"image_crop_size": [58, 58], "image_target_size": [64, 64], "use_albumentations": true,
        "min_pixels": 4096}"#;
    let untouched = processor(Version::N17, Preprocessing::Isaac, AS_IT_IS);
    for (name, preprocessing, options) in [
        ("albumentations_95", Preprocessing::Isaac, isaac),
        ("lerobot_albumentations_58", Preprocessing::Lerobot, lerobot),
    ] {
        let processor = processor(Version::N17, preprocessing, options);
        for sample in 0..7 {
            let found = view_of(&processor, &format!("{sample}.raw"));
            let expected = view_of(&untouched, &format!("{sample}.{name}"));
            assert!(found == expected, "{sample}.{name}");
        }
    }
}

#[test]
fn sizes_of_views_are_multiples_within_limits() {
    let few = r#"{"shortest_image_edge": null, "crop_fraction": 1.0}"#;
    let most = r#"{"shortest_image_edge": null, "crop_fraction": 1.0, "max_pixels": 250000}"#;
    for (version, options, frame, grid) in [
        (Version::N17, few, (256, 256), (256, 256)),
        (Version::N17, few, (256, 341), (256, 352)),
        // Half to even, as Python rounds: 5.5 and 6.5 become 6.
        (Version::N17, few, (176 * 2, 208 * 2), (352, 416)),
        (Version::N17, few, (10, 10), (256, 256)),
        (Version::N17, most, (1000, 1000), (480, 480)),
        (Version::N16, few, (256, 256), (252, 252)),
        (Version::N16, most, (1000, 1000), (476, 476)),
    ] {
        let processor = processor(version, Preprocessing::Isaac, options);
        let (height, width) = frame;
        let view = view(&processor, &vec![7; height * width * 3], &[height, width, 3]);
        let size = match (view.grid, view.pixels.shape()) {
            (Some([_, rows, columns]), _) => (16 * rows as usize, 16 * columns as usize),
            (None, shape) => (shape[2], shape[3]),
        };
        assert_eq!(size, grid, "{version}: {frame:?}");
    }
}

/// The released limits, of frames that are larger or smaller than any view.
#[test]
fn the_largest_views_have_the_released_areas() {
    for (version, tokens) in [(Version::N17, 128 * 128), (Version::N16, 64 * 64)] {
        let processor = processor(
            version,
            Preprocessing::Isaac,
            r#"{"shortest_image_edge": null, "crop_fraction": 1.0}"#,
        );
        let pixels = vec![7; 4200 * 4200 * 3];
        assert_eq!(
            view(&processor, &pixels, &[4200, 4200, 3]).tokens,
            tokens,
            "{version}"
        );
    }
}
