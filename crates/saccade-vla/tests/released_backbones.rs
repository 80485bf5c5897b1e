//! Backbones against the released code: features, and what the layers before them return, on every instruction set.

mod common;

use std::process::Command;

use common::{data, metadata};
use saccade_vla::{Array, Backbone, BackboneInputs, BackboneKeep, BackboneLoadOptions, Isa};
use safetensors::SafeTensors;
use serde_json::Value;

const FILES: [&str; 9] = [
    "n15_one_view",
    "n15_two_views",
    "n15_batch_padded",
    "n15_bf16",
    "n15_pixel_shuffle",
    "n16_two_views",
    "n17_one_view",
    "n17_two_views",
    "n17_batch_padded",
];

/// A tensor of a file, if it is there: its shape, and its elements as `of_bytes` reads them.
fn read<T, const N: usize>(
    file: &SafeTensors<'_>,
    name: &str,
    of_bytes: fn([u8; N]) -> T,
) -> Option<(Vec<usize>, Vec<T>)> {
    let tensor = file.tensor(name).ok()?;
    let (elements, rest) = tensor.data().as_chunks::<N>();
    assert!(rest.is_empty(), "{name} has elements of another size");
    Some((
        tensor.shape().to_vec(),
        elements.iter().copied().map(of_bytes).collect(),
    ))
}

/// Checks the difference from what the released code computes in float64.
fn assert_close(what: &str, given: &[f32], expected: &[f64], bound: impl Fn(f64) -> f64) {
    assert_eq!(given.len(), expected.len(), "{what}");
    for (index, (given, expected)) in given.iter().zip(expected).enumerate() {
        let error = (f64::from(*given) - expected).abs();
        assert!(error <= bound(*expected), "{what}, {index}: {given}, {expected}");
    }
}

/// The same of a layer before the features, whose error is that of its largest element.
fn assert_layer(what: &str, given: &[f32], expected: &[f64]) {
    let largest = expected
        .iter()
        .fold(1.0, |largest: f64, value| largest.max(value.abs()));
    assert_close(what, given, expected, |_| 2e-5 * largest);
}

#[test]
fn features_and_layers_are_the_released_ones() {
    for name in FILES {
        let path = data(&format!("backbone/{name}.safetensors"));
        let about = metadata(&path, "about");
        // The largest error of the released code in float32.
        let own_error = serde_json::from_str::<Value>(&about).unwrap()["f32_max_abs_vs_f64"]
            .as_f64()
            .unwrap();
        let options = BackboneLoadOptions {
            config: Some(about),
            num_threads: Some(2),
            ..BackboneLoadOptions::default()
        };
        let backbone = Backbone::load(&path, &options).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let file = SafeTensors::deserialize(&bytes).unwrap();
        let floats = |name: &str| read(&file, name, f32::from_le_bytes);
        let whole = |name: &str| read(&file, name, i64::from_le_bytes);
        let expected = |name: &str| read(&file, name, f64::from_le_bytes);
        let pixels: Vec<_> = ["_in.pixel_values", "_in.pixel_values.0", "_in.pixel_values.1"]
            .iter()
            .filter_map(|name| floats(name))
            .collect();
        let (ids_shape, ids) = whole("_in.input_ids").unwrap();
        let (_, mask) = whole("_in.attention_mask").unwrap();
        let mask: Vec<bool> = mask.iter().map(|&attended| attended != 0).collect();
        let grid = whole("_in.image_grid_thw");
        let inputs = BackboneInputs {
            pixel_values: pixels
                .iter()
                .map(|(shape, values)| Array::new(values, shape).unwrap())
                .collect(),
            input_ids: Array::new(&ids, &ids_shape).unwrap(),
            attention_mask: Some(Array::new(&mask, &ids_shape).unwrap()),
            image_grid_thw: grid
                .as_ref()
                .map(|(shape, values)| Array::new(values, shape).unwrap()),
        };
        let keep = BackboneKeep {
            hidden: true,
            vision: false,
            image_tokens: true,
        };
        let mut encoded = backbone.encode(&[inputs], &[], keep).unwrap();
        let features: Vec<f32> = (0..encoded[0].batch())
            .flat_map(|prompt| encoded[0].features(prompt).to_vec())
            .collect();
        let isa = backbone.engine().isa;
        let what = |part: &str| format!("{name} on {isa}, {part}");
        let (_, released) = expected("_out.backbone_features").unwrap();
        assert_close(&what("features"), &features, &released, |value| {
            4.0 * own_error + 1e-6 * value.abs().max(1.0)
        });
        let record = encoded[0].take_recorded();
        let tokens: Vec<f32> = record
            .image_tokens
            .iter()
            .flatten()
            .flat_map(|view| view.data().to_vec())
            .collect();
        let released = expected("_mid.mlp1.output").or_else(|| expected("_mid.vision.merger"));
        assert_layer(&what("tokens of views"), &tokens, &released.unwrap().1);
        for (layer, rows) in record.hidden.iter().enumerate() {
            // The last norm, and in one file another layer, come after the last of these.
            if let Some((_, released)) = expected(&format!("_mid.llm.layer.{layer}")) {
                assert_layer(&what(&format!("layer {layer}")), rows.data(), &released);
            }
        }
    }
}

/// The test above in a process of its own for each instruction set of this machine.
#[test]
fn on_every_instruction_set() {
    for isa in Isa::available() {
        let output = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "features_and_layers_are_the_released_ones"])
            .env("SACCADE_ISA", isa.to_string())
            .output()
            .unwrap();
        let shown = String::from_utf8_lossy(&output.stdout);
        assert!(
            output.status.success() && shown.contains("1 passed"),
            "{isa}: {shown}"
        );
    }
}
