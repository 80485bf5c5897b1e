//! The steps between a frame and its pixels, against those of the released processors.

use std::path::Path;

use saccade_vla_checkpoint::Checkpoint;
use saccade_vla_kernels::{Image, Isa};

use super::flexible::{fitting, prepared};
use super::frames::Bytes;
use super::settings::{Flexible, ProcessorOptions, Settings, Sizes};
use crate::release::{Preprocessing, Version};

/// A `(height, width, 3)` array of bytes of a fixture.
fn bytes(checkpoint: &Checkpoint, name: &str) -> Bytes<'static> {
    let mut pixels = Vec::new();
    checkpoint
        .read_bytes(name, |piece| {
            pixels.extend_from_slice(piece);
            Ok::<_, saccade_vla_checkpoint::Error>(())
        })
        .unwrap();
    let shape = checkpoint.shape(name).unwrap();
    Bytes::new(pixels, shape[0], shape[1])
}

fn sizes_of(version: Version, preprocessing: Preprocessing, options: &str) -> Flexible {
    let given = ProcessorOptions {
        preprocessing: Some(preprocessing),
        options: Some(options),
        ..ProcessorOptions::default()
    };
    let rules = version.release().processor.as_ref().unwrap();
    match Settings::new(version, rules, &given).unwrap().sizes {
        Sizes::Flexible(sizes) => sizes,
        Sizes::Square { .. } => panic!("the views of {version} have no fixed size"),
    }
}

#[test]
fn frames_before_the_last_resize() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/backbone/image_n17.safetensors");
    let checkpoint = Checkpoint::open(&path).unwrap();
    let isaac = r#"{"shortest_image_edge": 64, "crop_fraction": 0.95}"#;
    let lerobot =
        r#"{"image_crop_size": [58, 58], "image_target_size": [64, 64], "use_albumentations": true}"#;
    for (name, preprocessing, options) in [
        ("albumentations_95", Preprocessing::Isaac, isaac),
        ("lerobot_albumentations_58", Preprocessing::Lerobot, lerobot),
    ] {
        let sizes = sizes_of(Version::N17, preprocessing, options);
        for sample in 0..7 {
            for isa in Isa::available() {
                let raw = bytes(&checkpoint, &format!("{sample}.raw"));
                let found = prepared(&sizes, isa, "image", raw).unwrap();
                let expected = bytes(&checkpoint, &format!("{sample}.{name}"));
                assert_eq!(
                    (found.height, found.width),
                    (expected.height, expected.width),
                    "{sample}.{name}"
                );
                assert!(found.pixels == expected.pixels, "{sample}.{name} on {isa}");
            }
        }
    }
}

#[test]
fn sizes_of_views_are_multiples_within_limits() {
    for (version, frame, view) in [
        (Version::N17, (256, 256), (256, 256)),
        (Version::N17, (256, 341), (256, 352)),
        // Half to even, as Python rounds: 5.5 and 6.5 become 6.
        (Version::N17, (176 * 2, 208 * 2), (352, 416)),
        (Version::N17, (10, 10), (256, 256)),
        (Version::N17, (10_000, 10_000), (4096, 4096)),
        (Version::N16, (256, 256), (252, 252)),
        (Version::N16, (10_000, 10_000), (1792, 1792)),
    ] {
        let sizes = sizes_of(version, Preprocessing::Isaac, "{}");
        let (height, width) = frame;
        assert_eq!(fitting(&sizes, height, width), view, "{version}: {frame:?}");
    }
}

#[test]
fn crops_are_views_of_the_same_pixels() {
    let pixels: Vec<u8> = (0..60).collect();
    let image = Image::new(&pixels, 4, 5);
    let part = image.crop(1, 2, 2, 3);
    assert_eq!(part.row(0), &pixels[21..30]);
    assert_eq!(
        part.to_vec().unwrap(),
        [&pixels[21..30], &pixels[36..45]].concat()
    );
}
